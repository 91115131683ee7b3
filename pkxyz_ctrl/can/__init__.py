"""What is said over CAN, without a socket: frames, codec, start-up dialogue, amplifier driver."""
