"""The laws that can be designed, one file each, and the filter that they share."""
