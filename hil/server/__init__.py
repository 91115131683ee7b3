"""The server beside a loop in operation: clients, the one who holds control, and the page. No tick depends on it."""
