"""What bends beside the mechanism: flexible modes that act back, fingers that stand aside, a table that tilts."""
