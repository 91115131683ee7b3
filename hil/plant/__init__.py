"""The software plant as the node meets it: volts in, counts out, and what is true beside them."""
