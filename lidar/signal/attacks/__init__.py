"""Stages that an attacker causes: injected, replayed, removed and moved returns."""
