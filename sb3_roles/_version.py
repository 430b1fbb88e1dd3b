"""The version of sb3_roles, in one place."""

__version__ = "0.1.0"
