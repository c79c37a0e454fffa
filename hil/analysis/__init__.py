"""What a record says: derived signals, metrics, verdict, and the frames of the buses beside their bounds."""
