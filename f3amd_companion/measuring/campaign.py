"""The long queue: all that is trained on real motion, in order, in legs that go on where the last one stopped.

The queue stands in `papers/f3amd/campaign.toml`. Runs without a recipe follow the paper's text, but
for `-steady`. The learning rate depends on the step and not on the length of a run, so that each
snapshot of a long run is a fair row at its length. Snapshots are
kept as weights and measured by the protocol of `measures.protocol` with one seed; how far their
answers move with the noisy input, and with the noise level, and how far they are off, is measured
as well. All of it is one table, `records/campaign.csv`. A second queue, `readings_queue.toml`, compares readings of
the paper and fills `records/readings.csv` with what `measuring.fingerprint` says of each. Packages for a GPU that is
at hand for minutes stand in `gpu_plan.toml`; their weights are measured elsewhere, as readings are.

A queue may take months and machines: each
row names its commit and the style classifier that it was seen through (`records/classifiers.csv` has
how little two of one recipe differ).

Does the network use its noise? One that predicts clean motion can lower its loss by answering with the mean of what
history, path and style allow, and never look at its noisy input; one step then does as well as eight. Recipes (ours,
`papers/f3amd/recipes.toml`) differ from the paper's in one thing each; all see as many windows from the same seed.
"""

from __future__ import annotations

import itertools
import time
from collections import ChainMap
from collections.abc import Collection, Iterable, Iterator, Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace

import jax
import jax.numpy as jnp
import pandas as pd

import f3amd_lib
from f3amd_companion.measuring import fingerprint
from f3amd_companion.measuring.paper_tables import beside_paper
from f3amd_companion.measuring.runner import Records, records_folder
from f3amd_companion.measuring.times import compiled_steps, training_call
from f3amd_companion.speed.machine import device_name, matmul_precision, prepared_at_once
from f3amd_companion.speed.timing import take_turns
from f3amd_lib.data.windows import WindowSet
from f3amd_lib.ground import log
from f3amd_lib.ground.files import read_toml
from f3amd_lib.ground.names import check_known, checked_value
from f3amd_lib.ground.papers import check_entry, load_paper_file
from f3amd_lib.ground.profiles import Profile
from f3amd_lib.ground.records import read_table, run_record, write_table
from f3amd_lib.ground.trees import errors_name, weights_digest
from f3amd_lib.measures.classifier import StyleClassifier
from f3amd_lib.measures.denoising import held_out_condition, held_out_error, input_use, noise_use
from f3amd_lib.measures.distributions import intervals_over_repeats
from f3amd_lib.measures.protocol import Protocol, held_out_clips, measure_model
from f3amd_lib.measures.registry import METRICS
from f3amd_lib.networks import presets
from f3amd_lib.papers.printed import SCHEMAS, printed_tables
from f3amd_lib.rollout.rollout import MotionGenerator
from f3amd_lib.training.checkpoints import TrainedModel, load_model, save_model
from f3amd_lib.training.denoising_task import DenoisingTask
from f3amd_lib.training.optimise import differences, held_out_terms, restore_state
from f3amd_lib.training.pipeline import ModelFiles, PreparedData, as_trained, set_aside_run, train_in_legs
from f3amd_lib.training.recipe import TrainingConfig, paper_recipe

EPOCHS = 100
"""Of the whole run that the recipe is made for (section 4.5); snapshots come long before."""

STEPS_MEASURED = (8, 1)
"""Denoising steps with which a snapshot is measured."""

_EVERY = {"CPU": 400}
"""Steps between checkpoints, and looks at the held-out loss, by device: on a GPU 1,000, which takes it seconds."""

_QUEUES = Path(f3amd_lib.__file__).parent / "papers" / "f3amd"
QUEUES = {"campaign": _QUEUES / "campaign.toml", "readings": _QUEUES / "readings_queue.toml"}
"""Table of records -> its queue."""

GPU_PLAN = _QUEUES / "gpu_plan.toml"


@dataclass(frozen=True)
class Recipe:
    """One way to train `F3AMD-FNO-96`, or another model.

    Attributes:
      name: of the row; fit for a folder.
      change: what differs from the paper, in words.
      source: where the idea comes from.
      preset: what it starts from, unless a row of the queue names another.
      network: fields of the network's config that differ.
      training: fields of the training config that differ.
      loss: settings of its loss that differ.
    """

    name: str
    change: str
    source: str
    preset: str = "F3AMD-FNO-96"
    network: Mapping = field(default_factory=dict)
    training: Mapping = field(default_factory=dict)
    loss: Mapping = field(default_factory=dict)

    def config(self, num_steps: int, batch_size: int, seed: int) -> TrainingConfig:
        """Return the training config: the paper's, but for the row's change.

        Args:
          num_steps, batch_size, seed: the same for all rows that are compared; a row with a batch of its own sees as
            many windows, in other steps, of which it takes one at least.
        """
        settings = {"batch_size": batch_size, "seed": seed, "loss": self.loss, **self.training}
        num_steps = max(1, num_steps * batch_size // settings["batch_size"])
        if most := {"warmup_cosine": num_steps, "warmup_inverse_square": 200}.get(settings.get("schedule")):
            settings["warmup_steps"] = min(most, max(1, num_steps // 10))
        return paper_recipe(self.preset, num_steps, **settings)

    def on(self, preset: str) -> Recipe:
        """Return the same change of another model, which keeps its own network, losses and noise.

        Raises:
          ValueError: if the row changes one of these.
        """
        # Units of the loss are any model's, and small spectral weights any model's of the family.
        shared = {"small_spectral_weights"} if presets.find_preset(preset).family == "F3AMD" else set()
        also = {"loss": self.loss.keys() - {"raw_features"}, "diffusion": "diffusion" in self.training}
        own = [*(self.network.keys() - shared), *filter(also.get, also)]
        if preset != self.preset and (own or self.preset != Recipe.preset):
            what = f"its {', '.join(own)}" if own else "a recipe of its own"
            raise ValueError(f"{self.name} changes {what} of {self.preset}, so that it is no change of {preset}")
        return replace(self, preset=preset)


RECIPES: dict[str, Recipe] = {name: Recipe(name, **row) for name, row in load_paper_file("recipes").items()}
"""Rows by name, the paper's first."""


def find_recipe(name: str) -> Recipe:
    """Return a recipe by name, or several changes in one: "residual-prior+higher-learning-rate".

    Raises:
      ValueError: for an unknown name, with the nearest, or for changes of unlike networks or of the same thing.
    """
    parts = name.split("+")
    for part in parts:
        check_known(part, RECIPES, "recipe")
    rows = [RECIPES[part] for part in parts]
    changes = {part: [getattr(row, part) for row in rows] for part in ("network", "training", "loss")}
    together = {part: dict(ChainMap(*some)) for part, some in changes.items()}
    clash = any(len(together[part]) < sum(map(len, some)) for part, some in changes.items())
    if clash or len({row.preset for row in rows}) > 1:
        raise ValueError(f"{name}: these recipes change the same setting, or different networks; name one of them")
    words = [", ".join(getattr(row, field) for row in rows) for field in ("change", "source")]
    return Recipe(name, *words, rows[0].preset, **together)


@dataclass(frozen=True)
class Run:
    """One training of the queue.

    Attributes:
      preset: the model.
      recipe: row of `recipes.toml` that it is trained by; "paper" for the paper's text.
      window: frames of a window.
      seed: of weights and batches.
      length: thousands of windows after which a rate that hangs on a run's length has fallen; None: 100 epochs.
    """

    preset: str
    recipe: str = "paper"
    window: int = 32
    seed: int = 0
    length: int | None = None

    @property
    def name(self) -> str:
        """A name for files and tables: what differs from the usual is in it."""
        parts = [self.preset, "" if self.recipe == "paper" else self.recipe]
        parts += ["" if self.window == 32 else f"{self.window}frames", f"{self.length}k" if self.length else ""]
        parts.append(f"seed{self.seed}")
        return "-".join(filter(None, parts))

    def config(self, num_windows: int, batch_size: int) -> TrainingConfig:
        """Return the training config of `EPOCHS` epochs over so many windows, or of the run's own length."""
        steps = (1000 * self.length if self.length else EPOCHS * num_windows) // batch_size
        return find_recipe(self.recipe).on(self.preset).config(steps, batch_size, self.seed)


def queue(path: Path = QUEUES["campaign"], package: str | None = None) -> list[tuple[Run, int]]:
    """Return (run, windows seen) of every snapshot, in the order in which they are to be trained.

    Args:
      path: of the queue.
      package: of a plan, its runs alone.

    Raises:
      ValueError: naming the file, and the run in it, for what is no TOML, an unknown key, preset or recipe, or a value
        that makes no sense.
    """
    snapshots = []
    with errors_name(path):
        table = read_toml(path)
        if package is not None:
            check_known(package, table, "package of the plan")
            table = table[package]
        check_entry(table, str(path), ["run"], [] if package is None else ["note"])
        for number, row in enumerate(table["run"], 1):
            where = f"{path}: run {number}"
            check_entry(row, where, ["windows"], ["presets", "recipes", "seeds", "window", "length"])
            row = {"seeds": [0], "window": 32, "length": None, **row}
            lists, single = "tuple[int, ...]", "int | None"
            for key, kind in {"windows": lists, "seeds": lists, "window": single, "length": single}.items():
                checked_value(f"{key} of run {number}", row[key], kind, "0 or more" if key == "seeds" else "above 0")
            if not (row.get("presets") or row.get("recipes")):
                raise ValueError(f"{where}: names neither presets nor recipes")
            named = [presets.find_preset(name).name for name in row.get("presets", ())]
            for recipe in row.get("recipes") or ["paper"]:
                for preset, seed in itertools.product(named or [find_recipe(recipe).preset], row["seeds"]):
                    run = Run(preset, recipe, row["window"], seed, row["length"])
                    run.config(1000, 8)  # refuses a change that is none of this model's
                    snapshots += [(run, 1000 * thousands) for thousands in row["windows"]]
    return snapshots


def chosen(snapshots: Iterable[tuple[Run, int]], only: Collection[str]) -> list[tuple[Run, int]]:
    """Return the snapshots of a queue whose preset, recipe or run is named; all of them where none is.

    Raises:
      ValueError: for a name that is none of the queue's.
    """
    snapshots = list(snapshots)
    names = [{run.preset, run.recipe, run.name} for run, _ in snapshots]
    for name in only:
        check_known(name, set().union(*names), "name in the queue")
    return [one for one, called in zip(snapshots, names, strict=True) if not only or not called.isdisjoint(only)]


def _longest(snapshots: Iterable[tuple[Run, int]]) -> dict[Run, int]:
    """Return run -> windows of its last snapshot."""
    return dict(sorted(snapshots, key=lambda snapshot: snapshot[1]))


def longest_first(snapshots: Sequence[tuple[Run, int]]) -> list[tuple[Run, int]]:
    """Return the snapshots of a queue, longest runs first; those of a run stay in their order."""
    longest = _longest(snapshots)
    return sorted(snapshots, key=lambda snapshot: -longest[snapshot[0]])


def check_precision(precision: str) -> None:
    """Raise ValueError for a precision of training that is unknown, or that this device does not have."""
    check_known(precision, ("float32", "tf32"), "precision of training")
    if precision == "tf32" and device_name() == "CPU":
        raise ValueError("tf32 is for a GPU: on this CPU products are float32, leave --precision out")


def run_campaign(
    prepared: PreparedData, profile: Profile, classifier: StyleClassifier | None = None,
    protocol: Protocol | None = None, *, folder, snapshots: Iterable[tuple[Run, int]], batch_size: int = 128,
    precision: str = "float32", stop_at: float | None = None, known: Path | None = None, table: str = "campaign",
    found_alone: bool = False, progress: bool = True,
) -> Iterator[tuple[str, int, str]]:  # fmt: skip
    """Train and measure snapshots that are not on record, until all are or the time is over.

    Args:
      prepared, profile: the data, and where records go.
      classifier, protocol: of the measurement (`protocol.measure_model`), of which one seed is taken. Without them
        weights are kept and measured where there is time, for a GPU that is at hand for minutes: programs of all runs
        are compiled before the first one trains, on a GPU side by side, if JAX keeps a cache of them.
      folder: where training states and weights lie, a folder a run.
      snapshots: of `queue`, in the order in which they are trained.
      batch_size: windows a step, but for a recipe that has its own (the paper's is 512, for a GPU).
      precision: of the matrix products of training, a key of `machine.PRECISIONS`: float32, or tf32 on a GPU.
      stop_at: the run under way stops with a checkpoint after this time (`time.monotonic`).
      known: folder of another run's records, whose snapshots count as measured.
      table: a key of `QUEUES`: what is measured, and the record that it goes to.
      found_alone: measure snapshots whose weights lie in the folder, and train none.
      progress: show progress bars.

    Yields:
      (run, windows, state) for each snapshot: "measured before", "measured", "kept before" or "kept" of weights that
      are not measured, "not there" of weights that are not found, or "unfinished", which is the last.
    """
    check_precision(precision)
    snapshots, measured = list(snapshots), classifier is not None
    if measured and table != "reproduced":
        protocol = replace(protocol, num_seeds=1)
    if measured and table == "readings":  # what `walk_rows` walks
        walks = {"num_frames": fingerprint.NUM_FRAMES, "windows_per_style": fingerprint.WINDOWS_PER_STYLE}
        protocol = replace(protocol, styles=tuple(prepared.packed.styles), **walks)
    seed, about = (protocol.path_seed, {"protocol": asdict(protocol)}) if measured else (0, {})
    record = run_record(
        profile=profile, dataset=prepared.packed, seed=seed, measurement=table if measured else "package",
        batch_size=batch_size, **about,
    )  # fmt: skip
    how = {"batch_size": batch_size, "precision": precision, "record": record, "folder": folder}
    how |= {"stop_at": stop_at, "progress": progress}
    if measured:
        records = Records(records_folder(profile), record, {table: ["run", "windows"]}, known=known)
        if table == "readings" and not records.has(table, {"run": "real", "windows": 0}):
            clips, _ = held_out_clips(prepared.packed, prepared.packed.styles, prepared.window)
            real = fingerprint.real_rows(prepared.packed, clips, window=prepared.window)
            records.put(table, {"run": "real", "windows": 0}, real.assign(model="real", weights=""))
    elif jax.config.jax_compilation_cache_dir:
        compiled = lambda run: compiled_steps(_laid_out(prepared, run, batch_size)[1], 50, precision)
        for program in prepared_at_once(compiled, dict.fromkeys(run for run, _ in snapshots)).values():
            program()
    for run, windows in snapshots:
        key, there, state = {"run": run.name, "windows": windows}, _weights(folder, run, windows).exists(), "unfinished"
        if measured and records.has(table, key):
            state = "measured before"
        elif there and not measured:
            state = "kept before"
        elif found_alone and not there:
            state = "not there"
        elif stop_at is not None and time.monotonic() >= stop_at:
            pass
        elif not measured:
            state = "unfinished" if _trained(prepared, run, windows, **how) is None else "kept"
        elif (rows := _measured(prepared, classifier, protocol, run, windows, table, **how)) is not None:
            records.put(table, key, rows)
            state = "measured"
        yield run.name, windows, state
        if state == "unfinished":
            return


def _laid_out(prepared: PreparedData, run: Run, batch_size: int) -> tuple[PreparedData, DenoisingTask]:
    """Return the data in a run's windows, and what trains the run on them."""
    data = prepared if run.window == prepared.window else replace(prepared, window=run.window)
    config = run.config(data.windows("train").num_windows, batch_size)
    return data, data.task(run.preset, config, network=find_recipe(run.recipe).network)


def _weights(folder, run: Run, windows: int) -> Path:
    return Path(folder) / run.name / f"{windows}.safetensors"


def _trained(
    prepared, run: Run, windows: int, *, batch_size: int, precision: str, record, folder, stop_at, progress
) -> tuple[PreparedData, TrainedModel, float, TrainingConfig] | None:
    """Train a run to a snapshot and keep its weights, or take those that are there.

    It goes on from an earlier state; one that is further than the snapshot is kept under another name.

    Returns:
      (the data in the run's windows, model, held-out loss, config); None where the time was over before.
    """
    (data, task), file = _laid_out(prepared, run, batch_size), _weights(folder, run, windows)
    config, steps = task.config, max(1, windows // task.config.batch_size)
    files, held_out = ModelFiles.of(file.parent, run.preset), data.windows(data.held_out_split)
    reached = int(restore_state(files.state, task).step) if files.state.exists() else 0
    # A leg that was killed before it was measured has the state still, which is not rounded as the kept weights are.
    if file.exists() and reached != steps:
        found = load_model(file)
        if unlike := differences({"training": config.to_dict()}, found.record):
            raise ValueError(f"{file}: was trained with other {'; '.join(unlike)}; ask for those, or another --out")
        kept = SimpleNamespace(averaged=found.params, statistics=None)
        return data, found, held_out_terms(task, kept, held_out)["loss"], config
    if reached > steps:
        set_aside_run(files)
    record = {**record, "training": config.to_dict(), "precision": precision}
    every = min(steps, _EVERY.get(device_name(), 1000))
    with matmul_precision(precision):
        leg = {"stop_after": steps, "stop_at": stop_at, "progress": progress}
        state, _ = train_in_legs(task, files, record, held_out=held_out, every=every, **leg)
        if int(state.step) < steps:
            return None
        loss = held_out_terms(task, state, held_out)["loss"]
    record |= {"windows_seen": steps * config.batch_size}
    trained = as_trained(data, task, run.preset, state.averaged, record)
    save_model(file, trained, jnp.bfloat16)
    return data, trained, loss, config


def _measured(prepared, classifier, protocol, run: Run, windows: int, table: str, **how) -> pd.DataFrame | None:
    """Train a run to a snapshot, keep its weights and return its rows; None where the time was over before."""
    if (done := _trained(prepared, run, windows, **how)) is None:
        return None
    data, trained, loss, config = done
    log.info("measuring %s after %s windows", run.name, f"{windows:,}")
    held_out, seed = data.windows(data.held_out_split), protocol.path_seed
    of_paper = partial(_campaign_rows, steps=(8, 4, 2, 1))
    measure = {"campaign": _campaign_rows, "readings": _reading_rows, "reproduced": of_paper}[table]
    rows = measure(trained, data, classifier, protocol, held_out)
    use = input_use(trained, held_out_condition(held_out, trained), num_levels=STEPS_MEASURED[0], seed=seed)
    use = use.assign(steps=STEPS_MEASURED[0])[["metric", "unit", "value", "steps"]]
    errors = [loss, held_out_error(trained, held_out, seed=seed)]
    of_windows = pd.DataFrame({"steps": 0, "metric": ["held_out_loss", "held_out_error"], "value": errors})
    seen = max(1, windows // config.batch_size) * config.batch_size
    columns = {
        "model": run.preset, "recipe": run.recipe, "seed": run.seed, "window_frames": run.window,
        "epochs": seen / data.windows("train").num_windows, "weights": weights_digest(trained.params),
        "classifier": weights_digest(classifier.params),
        # Where it was trained, which may be elsewhere.
        "device": trained.record["device_kind"], "precision": trained.record.get("precision", how["precision"]),
        "commit": (trained.record["git_commit"] or "")[:10],
    }  # fmt: skip
    return pd.concat([rows, use, of_windows]).assign(**columns)


def _campaign_rows(
    trained, data: PreparedData, classifier, protocol: Protocol, held_out: WindowSet, steps=STEPS_MEASURED
) -> pd.DataFrame:
    generators = [MotionGenerator(trained, count) for count in steps]
    tables = [measure_model(one, data.packed, classifier, protocol, held_out)[0] for one in generators]
    table = pd.concat(tables)[["steps", "metric", "unit", "value"]]
    return table if steps == STEPS_MEASURED else intervals_over_repeats(table, ["steps", "metric", "unit"])


def _reading_rows(trained, data: PreparedData, classifier, protocol: Protocol, held_out: WindowSet) -> pd.DataFrame:
    use = noise_use(MotionGenerator(trained, STEPS_MEASURED[0]), held_out, seed=protocol.path_seed)
    names = ("x0_error_ratio", "seed_spread")
    figures = {"metric": names, "unit": ["", "cm"], "value": [use[METRICS[name].key] for name in names], "steps": 0}
    tables = [fingerprint.walk_rows(trained, data.packed, classifier, seed=protocol.path_seed), pd.DataFrame(figures)]
    if trained.diffusion.kind == "variance_exploding":
        tables.append(fingerprint.window_rows(trained, held_out, seed=protocol.path_seed))
    return pd.concat(tables, ignore_index=True)


# ------------------------------------------------------------------------------------------- a reader's own training


def own_queue(reading: str, num_windows: int, seed: int = 0) -> list[tuple[Run, int]]:
    """Return the snapshots of F3AMD-FNO-96 and CAMDM by a reading of the paper: at a tenth, a third and the end.

    Args:
      reading: a recipe, or several joined by "+"; CAMDM is trained by the paper's where it is no change of CAMDM.
      num_windows: that each sees in all.
      seed: of weights and batches.
    """
    recipe = find_recipe(reading)
    try:
        others = recipe.on("CAMDM").name
    except ValueError:
        others = "paper"
    runs = Run("F3AMD-FNO-96", reading, seed=seed), Run("CAMDM", others, seed=seed)
    return [(run, max(1, num_windows // part)) for run in runs for part in (10, 3, 1)]


def hours_of(prepared: PreparedData, snapshots, batch_size: int, precision: str = "float32") -> dict:
    """Return the hours that each run's training would take here, by name: ten steps are timed, after as many."""
    hours = {}
    for run, windows in _longest(snapshots).items():
        task = _laid_out(prepared, run, batch_size)[1]
        ten_steps = training_call(task, compiled_steps(task, 10, precision)[0])
        seconds = take_turns({run: ten_steps}, min_rounds=1, warmup=1)[run].median / 10
        hours[run.name] = seconds * windows / task.config.batch_size / 3600.0
    return hours


def reproduce_own(
    prepared: PreparedData, profile: Profile, classifier: StyleClassifier, protocol: Protocol, *, folder, reading: str,
    num_windows: int | None = None, batch_size: int = 512, seed: int = 0, **how,
) -> tuple[Path, Path] | None:  # fmt: skip
    """Train F3AMD-FNO-96 and CAMDM by a reading and lay Tables 3 and 5 beside the paper's.

    Args:
      prepared, profile, classifier, protocol, folder: as for `run_campaign`.
      reading: as for `own_queue`.
      num_windows: that are trained on; by default the paper's 100 epochs.
      batch_size, seed: of the training.
      **how: precision, stop_at and progress, as for `run_campaign`.

    Returns:
      (`records/reproduced_beside_paper.csv`; `records/reproduced_likeness.csv`, the distance to the paper's fingerprint
      line by line, under each grid and update); None where the time was over first.
    """
    total = num_windows or EPOCHS * prepared.windows("train").num_windows
    snapshots = own_queue(reading, total, seed)
    for name, hours in hours_of(prepared, snapshots, batch_size, how.get("precision", "float32")).items():
        log.info("training     %s: about %.1f hours here, for %s windows", name, hours, f"{total:,}")
    runs = prepared, profile, classifier, protocol
    for table in ("reproduced", "readings"):  # the fingerprint is F3AMD's
        some = [one for one in snapshots if table == "reproduced" or one[0].preset != "CAMDM"]
        left = {"folder": folder, "snapshots": some, "batch_size": batch_size, "table": table}
        for name, windows, state in run_campaign(*runs, **left, **how):
            log.info("%-12s %s, %s windows", state, name, f"{windows:,}")
            if state == "unfinished":
                return None
    place = records_folder(profile)
    (made, record), (walked, of_readings) = (read_table(place / f"{one}.csv") for one in ("reproduced", "readings"))
    made = made[made["run"].isin([run.name for run, _ in snapshots]) & (made["windows"] == total)]
    made = made.assign(window_frames=prepared.window)
    printed = printed_tables()["quality"]
    printed = printed[printed["model"].isin(made["model"]) & (printed["window_frames"] == prepared.window)]
    beside = write_table(place / "reproduced_beside_paper.csv", beside_paper(printed, made, SCHEMAS["quality"]), record)
    likeness = fingerprint.likeness_of_readings(walked)
    return beside, write_table(place / "reproduced_likeness.csv", likeness, of_readings)
