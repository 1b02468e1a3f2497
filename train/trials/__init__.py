"""Episodes of a policy and what they show: outcomes, success rates, the stress test."""
