"""The tuned default against slower ways to do the same work, in the same rounds."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

from sb3_roles.zoo.bench_case import TrainingCase, Work
from sb3_roles.zoo.bench_report import Table, against, cells, ratios, spread
from sb3_roles.zoo.options import UsageError

# What is compared, and how many times as fast the tuned default shall be; reported, never asserted.
RIVALS: dict[str, str] = {
    "stock-supersuit": "stock PPO, SuperSuit",
    "stock-native": "stock PPO, native environment",
    "literal": "literal fp32 update, per robot",
}
RATIO_TARGETS = {"stock-supersuit": 10.0, "stock-native": 5.0}
_PER_STEP = ("robot_steps", "samples_times_epochs", "optimizer_steps")


def check_same_work(name: str, tuned: Work, rival: Work) -> None:
    """Refuse a comparison of different work.

    :param name: of the rival
    :param tuned: what the tuned default did
    :param rival: what the rival did; in another number of joint steps, perhaps
    :raises UsageError: if a counter differs per joint step
    """
    for counter in _PER_STEP:
        mine, theirs = getattr(tuned, counter), getattr(rival, counter)
        # In whole numbers, exactly.
        if mine * rival.joint_steps != theirs * tuned.joint_steps:
            raise UsageError(
                f"{name}: the work is not the same: {counter} is {theirs:,} in "
                f"{rival.joint_steps:,} joint steps, and {mine:,} in {tuned.joint_steps:,} of the "
                "tuned default"
            )


class Comparison:
    """Rivals of a case, measured in its rounds.

    :param tuned: the case
    :param config: of the case
    :param names: keys of :data:`RIVALS`
    """

    def __init__(
        self, tuned: TrainingCase, config: Mapping[str, Any], names: Sequence[str]
    ) -> None:
        from sb3_roles.zoo.bench_literal import LiteralUpdate
        from sb3_roles.zoo.bench_stock import stock_case

        self.tuned = tuned
        self.stock = {
            name: stock_case(name, config, name.removeprefix("stock-"))
            for name in names
            if name.startswith("stock-")
        }
        self.literal = LiteralUpdate(tuned.model) if "literal" in names else None
        self.ratios: dict[str, list[float]] = {name: [] for name in self.stock}
        self.difference = 0.0
        # Joint steps per second of updates alone, on the same rollouts.
        self.literal_rates: list[float] = []
        self.tuned_rates: list[float] = []
        self.literal_work = Work()

    def measure(self, iterations: int) -> None:
        """Measure all rivals once, each of them right behind the tuned default.

        :param iterations: of the tuned default; rivals make one
        :raises UsageError: if the work, or the literal forward pass, is not the same
        """
        for name, case in self.stock.items():
            self.tuned.measure(iterations)
            case.measure(1)
            check_same_work(name, self.tuned.work, case.work)
            self.ratios[name].append(self.tuned.rates[-1] / case.rates[-1])
        if self.literal is not None:
            self.literal.load()
            self.difference = max(self.difference, self.literal.check())
            seconds, self.literal_work = self.literal.update()
            again, work = self.tuned.repeat_update()
            check_same_work("literal", work, self.literal_work)
            self.literal_rates.append(work.joint_steps / seconds)
            self.tuned_rates.append(work.joint_steps / again)

    def describe(self) -> list[dict[str, Any]]:
        """Return what was measured, plain data."""
        found = []
        for name, case in self.stock.items():
            found.append(
                {
                    "name": name,
                    "measured": "training",
                    "joint_steps_per_second": spread(case.rates),
                    "ratio": against(spread(self.ratios[name]), RATIO_TARGETS.get(name)),
                    "parameters": sum(one.numel() for one in case.model.policy.parameters()),
                    "work": asdict(case.work),
                }
            )
        if self.literal is not None:
            found.append(
                {
                    "name": "literal",
                    "measured": "update",
                    "joint_steps_per_second": spread(self.literal_rates),
                    "tuned_joint_steps_per_second": spread(self.tuned_rates),
                    "ratio": against(spread(ratios(self.tuned_rates, self.literal_rates)), None),
                    "parameters": sum(one.numel() for one in self.tuned.model.policy.parameters()),
                    "work": asdict(self.literal_work),
                    "forward_difference": self.difference,
                }
            )
        return found

    def close(self) -> None:
        """Close the environments."""
        for case in self.stock.values():
            case.close()


def comparison_table(found: Sequence[Mapping[str, Any]]) -> Table:
    """Set what :meth:`Comparison.describe` returned.

    :param found: at least one comparison
    """
    table = Table(
        ("tuned default against", "joint steps/s", "times as fast", "range", "target",
         "samples x epochs", "optimizer steps")
    )  # fmt: skip
    for one in found:
        median, low_high, target = cells(one["ratio"], ".1f")
        work = one["work"]
        per_1000 = (
            1000 * work[counter] / work["joint_steps"]
            for counter in ("samples_times_epochs", "optimizer_steps")
        )
        table.add(
            rival_label(one),
            f"{one['joint_steps_per_second']['median']:,.0f}",
            median,
            low_high,
            target,
            *(f"{number:,.0f} / 1,000" for number in per_1000),
        )
    return table


def rival_label(one: Mapping[str, Any]) -> str:
    """Name a comparison for people."""
    suffix = " (update alone)" if one["measured"] == "update" else ""
    return RIVALS[one["name"]] + suffix
