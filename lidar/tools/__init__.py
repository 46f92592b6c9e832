"""What is done with recorded data: maps, odometry, evaluation, attacks and defences, figures."""
