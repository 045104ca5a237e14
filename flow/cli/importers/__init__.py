"""`roverflow import KIND`: one module a kind of recording."""
