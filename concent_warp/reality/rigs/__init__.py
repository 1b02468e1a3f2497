"""Small experiments in Reality."""
