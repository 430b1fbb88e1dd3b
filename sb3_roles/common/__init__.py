"""What all team algorithms share."""
