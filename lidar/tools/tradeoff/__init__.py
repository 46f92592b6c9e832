"""What each setting of a drive costs, and which error it causes, measured against an exact reference."""
