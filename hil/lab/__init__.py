"""The stability lab: how far a closed loop is from failing, in which direction, and how sure that is."""
