"""`roverflow import KIND`: one module a kind of recording, and what they share."""
