"""Pictures of what a process makes of a drawing."""
