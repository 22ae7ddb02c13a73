"""The world: truth, sensors, the radio channel, the record and its referees."""
