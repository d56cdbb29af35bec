"""When a run is over, on which scenes it is, and what it writes down."""

from dataclasses import dataclass


@dataclass(frozen=True, kw_only=True)
class BudgetConfig:
    """When a run is over; whichever comes first."""

    updates: int = 3_750_000
    """Updates of the learner (the paper's 30 million steps at ratio 8, batch 64)."""
    minutes: float = 0.0
    """Minutes since the first update, over all restarts; 0 is no limit."""

    def __post_init__(self) -> None:
        """Refuses a run that is over before it begins."""
        if self.updates < 1 or self.minutes < 0:
            raise ValueError(
                f"budget: updates={self.updates} must be at least 1 and minutes="
                f"{self.minutes} not negative"
            )


@dataclass(frozen=True, kw_only=True)
class ScenesConfig:
    """Scenes made by the procedural generator."""

    train: int = 256
    """Scenes to train on."""
    held_out: int = 64
    """Scenes to evaluate on, of another seed."""
    seed: int = 0
    """Of the generator."""
    held_out_share: float = 0.2
    """Of recorded scenes, this share is held out, at least one if there are two."""


@dataclass(frozen=True, kw_only=True)
class ReportConfig:
    """What a run writes down, and how often."""

    checkpoint_s: float = 30.0
    """Seconds between two checkpoints."""
    checkpoints: int = 3
    """Newest checkpoints kept."""
    curves_s: float = 2.0
    """Seconds between two rows of the curves."""
    tensorboard: bool = True
    """Write TensorBoard events beside the CSV file."""
    rollouts: int = 12
    """Evaluation rollouts recorded for the viewer."""


@dataclass(frozen=True, kw_only=True)
class EvaluatorConfig:
    """The evaluation beside the training: `launch.evaluator`."""

    scenes: int = 64
    """Held-out scenes that each checkpoint drives, the first ones; 0: no evaluator."""
    seconds: float = 60.0
    """From the beginning of an evaluation to the next one's, at least."""
    updates: int = 0
    """Updates from an evaluated checkpoint to the next one, at least."""

    def __post_init__(self) -> None:
        """Refuses negative numbers."""
        for name in ("scenes", "seconds", "updates"):
            if not getattr(self, name) >= 0:
                raise ValueError(
                    f"evaluator: {name}={getattr(self, name)} must not be negative"
                )
