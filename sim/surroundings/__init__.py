"""What the room does to the stage: it shakes, hums, warms and ages; and the amplifier's own noise."""
