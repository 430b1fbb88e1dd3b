"""``TeamProgressBar``: Stable-Baselines3's progress bar, counted in joint steps."""

from __future__ import annotations

from stable_baselines3.common.callbacks import ProgressBarCallback
from tqdm.rich import tqdm  # type: ignore[import-untyped]

from sb3_roles.common.team_wrapper import find_team_env


class TeamProgressBar(ProgressBarCallback):
    """Shows steps of whole teams, as configurations and logs count them, for every algorithm.

    ``learn(progress_bar=True)`` counts the rows, that is robots, instead. A run that is resumed
    begins where it was.
    """

    def _on_training_start(self) -> None:
        team_env = find_team_env(self.training_env)
        self._n_teams = team_env.n_teams
        self.pbar = tqdm(
            total=int(self.locals["total_timesteps"]) // team_env.n_agents,
            initial=int(self.model.num_timesteps) // team_env.n_agents,
            unit="step",
        )

    def _on_step(self) -> bool:
        self.pbar.update(self._n_teams)
        return True
