"""What a law is designed on: discrete models of stage, amplifier, sense chain and delay."""
