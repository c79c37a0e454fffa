"""Robot descriptions: pure data, and the types that read it. Imports nothing of the project."""
