"""The evolution strategy over sphere positions (paper, appendix A)."""
