"""How far a loop is from instability, computed and measured."""
