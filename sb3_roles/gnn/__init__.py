"""Learned rivals on the team's graph: GNN, cloned from demonstrations, and the policy of H2GNN."""

from sb3_roles.gnn.gnn import GNN
from sb3_roles.gnn.policies import GNNPolicy, H2GNNPolicy

__all__ = ["GNN", "GNNPolicy", "H2GNNPolicy"]
