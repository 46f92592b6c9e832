"""Errors and costs of the settings of a build."""
