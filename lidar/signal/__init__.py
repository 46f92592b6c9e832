"""Stages: named steps that change echoes, point clouds or images between physics and files."""
