"""What a controller is: anything with Stable-Baselines3's ``predict()``."""

from __future__ import annotations

from abc import ABC, abstractmethod
from typing import TYPE_CHECKING, Protocol

import numpy as np

if TYPE_CHECKING:
    from area_search.batch import BatchedAreaSearch

States = tuple[np.ndarray, ...]


class Controller(Protocol):
    """Chooses the actions of whole teams; ``PolicyController`` makes one of an SB3 model.

    Optional attributes: ``sub_goal`` (path features that the batch shall observe), ``roles`` (int8
    (n_teams, n_agents), those of the last step) and ``role_names``, ``name`` (a label),
    ``description`` (a dict of JSON values that tells it from others of its class),
    ``deterministic`` and ``communicate`` (where it has such a choice; None: it has none), and
    ``bounds`` (float (n_teams,), numbers of targets that nobody can exceed in the episodes of the
    current batch, known after their last step; NaN: not known). Records keep all but the first two.
    """

    def begin(self, batch: BatchedAreaSearch) -> None:
        """Take the teams to control; all of them have just begun an episode."""

    def predict(
        self,
        observation: dict[str, np.ndarray],
        state: States | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, States | None]:
        """Choose an action for each row.

        :param observation: empty when episodes are played: controllers read the batch
        :param state: what the last call returned, None at first
        :param episode_start: bool (rows,), True where an episode begins
        :param deterministic: take the likeliest action instead of drawing one
        :return: integer actions (rows,), and the state for the next call
        """


class ScriptedController(ABC):
    """A controller that reads the team's map from the simulation instead of an observation.

    Subclasses implement :meth:`act`, and :meth:`begin` if they keep something during an episode.
    What they do must be a function of the team's episode alone, so that no result depends on which
    teams are simulated together.
    """

    batch: BatchedAreaSearch | None = None

    def begin(self, batch: BatchedAreaSearch) -> None:
        """Take the teams to control; all of them have just begun an episode.

        :param batch: read only, and only what a team may know
        """
        self.batch = batch

    @abstractmethod
    def act(self, batch: BatchedAreaSearch) -> np.ndarray:
        """Choose the next action of every robot.

        :param batch: what :meth:`begin` was given
        :return: integer (n_teams, n_agents)
        """

    def predict(
        self,
        observation: dict[str, np.ndarray],
        state: States | None = None,
        episode_start: np.ndarray | None = None,
        deterministic: bool = False,
    ) -> tuple[np.ndarray, States | None]:
        """Choose an action for each row, see :class:`Controller`; all arguments are ignored.

        :raises RuntimeError: if :meth:`begin` was not called
        """
        if self.batch is None:
            raise RuntimeError(
                f"{type(self).__name__} reads the map of the teams: call begin(batch) first"
            )
        return self.act(self.batch).reshape(-1), state
