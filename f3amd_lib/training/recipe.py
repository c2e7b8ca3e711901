"""How a network is trained: all the settings, and the recipes that choose them (section 4.5).

A preset's own noise, losses and remedies stand in `networks.presets`; the length of the run and what
goes with it is chosen here.
"""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path

import optax

from f3amd_lib.diffusion.schedules import NoiseSchedule, schedule_from_dict, variance_exploding
from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import checked_value, refuse_unknown
from f3amd_lib.ground.profiles import Profile
from f3amd_lib.networks.presets import find_preset

_SETTINGS = read_toml(Path(__file__).with_name("settings.toml"))

PAPER_STEPS = 390_000
"""Of 512 windows in the paper's 100 epochs: its windows of 100STYLE (section 4.5), counted by us."""


def check_settings(settings, kind: str = "") -> None:
    """Raise ValueError for a field that is not of its type, or not what `settings.toml` says of it.

    Args:
      settings: of any dataclass; its numbers are above 0 where the file says nothing else.
      kind: what its fields are, before their names in a message, such as "loss weight ".
    """
    rules = _SETTINGS.get(type(settings).__name__, {})
    for each in dataclasses.fields(settings):
        checked_value(kind + each.name, getattr(settings, each.name), each.type, rules.get(each.name, "above 0"))


@dataclass(frozen=True)
class LossWeights:
    """Weights of the terms, and the form of the inter-round discontinuity.

    Attributes:
      sample: lambda of Eq. 11.
      position: lambda of Eq. 12.
      feature_velocity, joint_velocity: lambda of the two halves of Eq. 13 (the paper has one).
      foot: lambda of the foot-contact term.
      floor: lambda of our term against sinking; the paper has none.
      ird: lambda of Eq. 10.
      ird_form: "literal" is Eq. 10, the distance between the last frame before the seam and the
        first after it, which asks the character to stand still there; "squared" is its square, as all
        other terms are; "excess" measures the step across the seam against the step that the data takes.
      raw_features: compare features in metres and 6D numbers, as CAMDM's code does, which the paper
        adopts (section 4.1), instead of network units.

    Raises:
      ValueError: for a weight that is negative or not finite, or an unknown form.
    """

    sample: float = 1.0
    position: float = 1.0
    feature_velocity: float = 1.0
    joint_velocity: float = 1.0
    foot: float = 1.0
    floor: float = 0.0
    ird: float = 1.0
    ird_form: str = "literal"
    raw_features: bool = False

    def __post_init__(self):
        check_settings(self, "loss weight ")


@dataclass(frozen=True)
class TrainingConfig:
    """How a network is trained; with the model's config, all that decides its weights.

    Attributes:
      num_steps: optimiser steps in all.
      batch_size: windows a step (paper: 512).
      learning_rate: peak value (paper: 5e-4).
      schedule: "inverse_square" is the paper's text, lr (1 + step / decay_steps)^-2;
        "inverse_sqrt" the usual reading of such schedules; "compressed_..." either of them falling as far in
        `num_steps` as the paper's 100 epochs let it fall; "warmup_cosine" ours, for short runs;
        "warmup_inverse_square" the paper's after a linear rise.
      decay_steps: the paper's decay constant, 1e5.
      warmup_steps: of the schedules that rise first.
      ema_decay: moving average of the weights (paper: 0.993); what is evaluated and shipped.
      gradient_clip: largest global gradient norm; 0 clips nothing (the paper names none).
      noise: "schedule" draws levels as the schedule says (Eq. 9: t uniform); "mixed" (ours) draws
        every second sigma log-uniform between sigma_min and 1, where the noisy input says something
        that the condition does not; "log_normal" (ours) draws the logarithm from
        `LOG_NORMAL_SIGMA`, cut off at the ends of the schedule.
      noise_weighting: "uniform" weighs all noise levels alike; "low_noise" (ours) by
        1 + min(1 / sigma^2, 5), the weight of Karras et al. 2022 for a clean estimate, capped, and
        divided by its mean over the batch.
      history_noise: deviation, in network units, of noise added to the history in training (ours;
        0 in paper presets): rounds are started from generated frames, which are never quite real.
      history_dropout: share of samples whose history is set to 0 (CAMDM's code: 0.15; F3AMD
        mentions none).
      condition_dropout: share of samples that see no condition at all, history, path and style 0
        (ours; 0 in paper presets), so that only the noisy input can tell them what to make.
      captured_path_share: share of samples whose path condition is the captured root, sway and all;
        the rest see a smoothed one, as users draw them (CAMDM: 0.5).
      own_history_share: share of samples that start from the network's own last frames of the
        window before, made in one step without gradient, instead of captured ones (ours; 0 in
        paper presets). Without it small losses of swing add up over rounds until nobody walks.
        It rises from 0 between 10 and 40 % of the run, or of the first 4,000 steps of a longer one, when there is
        something to learn from.
      history_damping: share of samples whose history is pulled towards the mean pose of its style,
        by a random amount, while the target soon returns to what was captured (ours; 0 in paper
        presets): the same remedy, for histories that have lost the swing of more than one round.
      loss: weights of the loss terms.
      diffusion: the noise schedule (section 4.5).
      seed: of initial weights and batches.

    Raises:
      ValueError: for an unknown schedule or noise name, or sizes that are not positive.
    """

    num_steps: int
    batch_size: int = 512
    learning_rate: float = 5e-4
    schedule: str = "inverse_square"
    decay_steps: float = 1e5
    warmup_steps: int = 200
    ema_decay: float = 0.993
    gradient_clip: float = 0.0
    noise: str = "schedule"
    noise_weighting: str = "uniform"
    history_noise: float = 0.0
    history_dropout: float = 0.0
    condition_dropout: float = 0.0
    captured_path_share: float = 0.5
    own_history_share: float = 0.0
    history_damping: float = 0.0
    loss: LossWeights = field(default_factory=LossWeights)
    diffusion: NoiseSchedule = field(default_factory=variance_exploding)
    seed: int = 0

    def __post_init__(self):
        check_settings(self)
        # The other draws reach below 1 by a logarithm, which such a schedule alone has room for.
        exploding = self.diffusion.kind == "variance_exploding"
        if self.noise != "schedule" and not (exploding and self.diffusion.sigma_min < 1.0):
            raise ValueError(
                f"{self.noise} noise needs a variance-exploding schedule with sigma_min below 1, got {self.diffusion!r}"
            )

    def optimiser(self) -> optax.GradientTransformation:
        """Return Adam at the config's learning rate (section 4.5), after clipping where it asks for it."""
        clipping = [optax.clip_by_global_norm(self.gradient_clip)] if self.gradient_clip else []
        return optax.chain(*clipping, optax.adam(learning_rate_schedule(self)))

    def to_dict(self) -> dict:
        """Return the fields as JSON-ready values."""
        return dataclasses.asdict(self) | {"diffusion": self.diffusion.to_dict()}

    @classmethod
    def from_dict(cls, values: dict) -> TrainingConfig:
        """Build a config from `to_dict`; an unknown key is an error that names the nearest."""
        refuse_unknown(values, cls, "training setting")
        loss, diffusion = values.get("loss"), values.get("diffusion")
        if isinstance(loss, Mapping):
            refuse_unknown(loss, LossWeights, "loss setting")
            values = {**values, "loss": LossWeights(**loss)}
        if isinstance(diffusion, Mapping):
            values = {**values, "diffusion": schedule_from_dict(diffusion)}
        return cls(**values)


def paper_recipe(preset: str, num_steps: int, **settings) -> TrainingConfig:
    """Return how the paper trains a preset (section 4.5), but for the number of steps.

    Args:
      preset: see `presets.find_preset`; its own noise, losses and remedies are in it.
      num_steps: optimiser steps.
      **settings: fields of `TrainingConfig` to change.
    """
    chosen = find_preset(preset)
    settings = {"num_steps": num_steps, "diffusion": chosen.diffusion, **chosen.training, **settings}
    if isinstance(settings.get("loss"), Mapping):  # what is said of a loss goes over what the preset says of its own
        settings["loss"] = {**chosen.training.get("loss", {}), **settings["loss"]}
    return TrainingConfig.from_dict(settings)


def short_recipe(preset: str, num_steps: int, **settings) -> TrainingConfig:
    """Return how a preset is trained in a run far shorter than the paper's 100 epochs.

    As `paper_recipe`, with a warm-up and a cosine from a higher rate, which short runs need (the
    paper's schedule is `TrainingConfig`'s default).

    Args:
      preset, num_steps, **settings: as for `paper_recipe`.
    """
    short = {"batch_size": 128, "learning_rate": 2e-3, "schedule": "warmup_cosine", "gradient_clip": 1.0}
    short["warmup_steps"] = max(1, min(200, num_steps // 10))
    return paper_recipe(preset, num_steps, **short | settings)


def profile_recipe(profile: Profile, preset: str | None = None) -> TrainingConfig:
    """Return how a profile trains a preset: as the paper on `gpu`, by a short recipe elsewhere.

    Args:
      profile: says how long, in which batches, at which rate and from which seed.
      preset: by default the profile's own; our own recipes are short ones on `gpu` too.
    """
    preset = find_preset(preset or profile.preset).name
    as_printed = profile.name == "gpu" and not preset.endswith(("-plus", "-steady"))
    recipe = paper_recipe if as_printed else short_recipe
    own = {name: getattr(profile, name) for name in ("learning_rate", "batch_size", "seed")}
    return recipe(preset, profile.train_steps, **own)


def learning_rate_schedule(config: TrainingConfig) -> optax.Schedule:
    """Return learning rate against step (section 4.5: "inverse-square")."""
    if config.schedule == "warmup_cosine":
        warm, peak = min(config.warmup_steps, config.num_steps - 1), config.learning_rate
        return optax.warmup_cosine_decay_schedule(0.0, peak, warm, config.num_steps, 0.01 * peak)
    power = -0.5 if config.schedule.endswith("inverse_sqrt") else -2.0
    compressed = config.schedule.startswith("compressed")
    decay_steps = config.decay_steps * config.num_steps / PAPER_STEPS if compressed else config.decay_steps
    falling = lambda step: config.learning_rate * (1.0 + step / decay_steps) ** power
    if config.schedule != "warmup_inverse_square":
        return falling
    rising = optax.linear_schedule(0.0, 1.0, config.warmup_steps)
    return lambda step: rising(step) * falling(step)
