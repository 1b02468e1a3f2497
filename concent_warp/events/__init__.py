"""Contact events, their staging and the schedule plot."""
