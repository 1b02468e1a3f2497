"""What the worlds on other engines than MuJoCo have in common: experiments, drives, hidden effects, recordings."""
