"""Proofs of what is promised about reliability: ``sb3-roles prove``, one experiment a promise."""
