"""Tools for recorded data: maps, odometry, evaluation, attacks and defences, figures."""
