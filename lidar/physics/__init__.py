"""What a laser pulse gives back: power, detection, noise, echoes and codes."""
