"""Conformance checks that anyone can call on an environment, a buffer or a loss of their own."""
