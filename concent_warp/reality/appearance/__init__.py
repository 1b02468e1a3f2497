"""What Reality looks like."""
