"""The search for missing effects: candidates, screening, evidence."""
