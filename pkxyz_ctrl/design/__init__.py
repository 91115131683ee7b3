"""What makes a law's numbers offline, and checks them against other libraries."""
