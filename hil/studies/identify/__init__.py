"""What this very stage is, measured in the running loop."""
