"""Defences against spoofing, which judge recorded frames, and their scores against the truth."""
