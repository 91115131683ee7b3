"""The truth: a plant that shares no code with the controller, so that a mistake there cannot cancel here."""
