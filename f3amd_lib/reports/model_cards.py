"""A card for every model that ships: what it is, its data, how well it does, its limits.

    python -m f3amd_lib.reports.model_cards        # writes cards, checksums and README's table

Everything on a card is read from the weights file and from committed results; nothing is typed in.
"""

from __future__ import annotations

import hashlib
import logging
import re
import sys
from pathlib import Path

import jax
import pandas as pd

from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.records import read_table
from f3amd_lib.ground.tables import markdown_table
from f3amd_lib.reports.quality_tables import figure_text, readme_table
from f3amd_lib.training.checkpoints import describe, load_model, weights_digest
from f3amd_lib.training.pipeline import PRETRAINED_DIR

log = logging.getLogger("f3amd")

CARD_FIGURES = {
    "FID": "FID",
    "EMD": "EMD",
    "style_coverage": "Style (%)",
    "trajectory_error": "Traj. (m)",
    "direction_error": "Dir. (degrees)",
    "foot_sliding": "Foot",
    "contact_share": "contact share",
    "foot_alternation": "changes of the resting foot (1/s)",
    "stepping_rate": "steps by toe height (1/s)",
    "slide_speed": "slide of the lower toe (cm/s)",
    "sliding_share": "share of frames that slide over 30 cm/s",
    "floor_penetration": "deepest toe under the floor (cm)",
    "seam_kick": "kick at the seams",
    "IRD": "IRD (cm)",
    "IRD_excess": "IRD excess (cm)",
    "joint_acceleration": "joint acceleration (cm/frame²)",
    "path_drift": "drift (m per m)",
    "seed_spread": "seed spread (cm)",
    "x0_error_ratio": "x0 error, low over high noise",
}
"""Figures on a card, with their headings."""


def _figures(name: str, weights: str, quality: pd.DataFrame | None) -> pd.DataFrame | None:
    """Return the table of a model's figures beside real motion's, or None if not measured."""
    if quality is None or "weights" not in quality:
        return None
    mine = quality[(quality["model"] == name) & (quality["weights"] == weights)]
    if mine.empty:
        return None
    real = quality[quality["model"] == "real"]
    columns = {f"{steps} steps" if steps > 1 else "1 step": mine[mine["steps"] == steps]
               for steps in sorted(mine["steps"].unique(), reverse=True)}  # fmt: skip
    rows = []
    for metric, heading in CARD_FIGURES.items():
        row = {"figure": heading}
        for label, part in (columns | {"real motion": real}).items():
            found = part[part["metric"] == metric]
            row[label] = "–" if found.empty else figure_text(*found.iloc[0][["value", "low", "high"]])
        rows.append(row)
    return pd.DataFrame(rows)


def _limits(name: str, weights: str, quality: pd.DataFrame | None) -> list[str]:
    """Return sentences on what a model does badly, as far as its figures say so."""
    if quality is None or "weights" not in quality:
        return []
    mine = quality[(quality["model"] == name) & (quality["weights"] == weights)]
    mine = mine[mine["steps"] == mine["steps"].max()] if len(mine) else mine
    value = mine.set_index("metric")["value"]
    real = quality[quality["model"] == "real"].set_index("metric")["value"]
    found = []
    if value.get("x0_error_ratio", 0.0) > 0.5:
        found.append("It hardly uses its noisy input: every seed gives nearly the same motion.")
    if value.get("stepping_rate", 1e9) < 0.8 * real.get("stepping_rate", 0.0):
        found.append(
            f"It steps too rarely: {value['stepping_rate']:.1f} times a second, where the source "
            f"steps {real['stepping_rate']:.1f} times."
        )
    if value.get("slide_speed", 0.0) > 12.0:
        found.append(
            f"It skates: its lower toe moves over the ground at {value['slide_speed']:.0f} cm/s "
            f"(median), where that of the source moves at {real['slide_speed']:.0f}."
        )
    if value.get("floor_penetration", 0.0) > 1.0:
        found.append(
            f"Toes sink: in the worst frame of a walk by {value['floor_penetration']:.1f} cm on average over styles."
        )
    if value.get("joint_acceleration", 0.0) > 1.5 * real.get("joint_acceleration", 1e9):
        found.append("It trembles: joints accelerate more than 1.5 times as much as in real motion.")
    return found


def model_card(path: Path, quality: pd.DataFrame | None) -> str:
    """Write the card of one weights file.

    Args:
      path: the weights.
      quality: `records/quality_by_seed.csv` summed up with a column of weights, or None; rows of
        other weights are not used.

    Returns:
      Markdown.

    Raises:
      ValueError: if the file is broken.
    """
    path = Path(path)
    trained, told = load_model(path), describe(path)
    record, recipe = trained.record, trained.record["training"]
    windows = recipe["num_steps"] * recipe["batch_size"]
    passes = windows / record["num_train_windows"]
    count = sum(leaf.size for leaf in jax.tree.leaves(trained.params))
    history, _ = read_table(path.with_name(f"{path.stem}.history.csv"))
    losses = history["held_out_loss"].dropna()
    state = " from a work tree with uncommitted changes" if record["git_dirty"] else ""
    free = "NC" not in re.split(r"[\s-]+", record["dataset_licence"])
    commit = (record["git_commit"] or "unknown")[:10]
    lines = [
        f"# {trained.name}, trained on `{record['dataset']}`",
        "",
        f"- **File**: `{path.name}`, {path.stat().st_size / 1e6:.1f} MB, {count:,} parameters in "
        f"{told.get('weights', 'bfloat16')}",
        f"- **Terms**: {record['dataset_licence']}, as of the data" + ("" if free else ": **non-commercial use only**"),
        f"- **Data**: {record['dataset_credit']} The starting poses are excerpts.",
        f"- **Styles**: {', '.join(trained.styles)}",
        f"- **Training**: {recipe['num_steps']:,} steps of {recipe['batch_size']} windows "
        f"({windows:,} windows, {passes:.2f} passes over {record['num_train_windows']:,}; "
        f"the paper: 100 passes, batches of 512), learning rate {recipe['learning_rate']:g} "
        f"(`{recipe['schedule']}`), moving average {recipe['ema_decay']:g}, "
        f"{record['cores']} cores ({record['device_platform']}), {record['date_utc'][:10]}, "
        f"commit {commit}{state}",
        f"- **Held-out loss**: {losses.iloc[-1]:.4f} at the end (its own loss; losses of different "
        "recipes do not compare)",
        "",
    ]
    figures = _figures(trained.name, weights_digest(trained.params), quality)
    lines += ["## Measured", ""]
    if figures is None:
        lines += ["Not measured by the protocol yet.", ""]
    else:
        lines += [markdown_table(figures), ""]
        lines += [
            "Means and 95 % intervals over seeds, by notebook 07's protocol with these weights. "
            "FID and EMD compare within this data set alone.",
            "",
        ]
    lines += ["## Limits", ""]
    limits = _limits(trained.name, weights_digest(trained.params), quality)
    limits.append("It knows the walks, runs and styles of its data, on level ground, and no others.")
    if passes < 20:
        limits.append("It was trained far shorter than the paper's models.")
    lines += [f"- {limit}" for limit in limits]
    lines += [
        "",
        "## Use",
        "",
        "```python",
        "from f3amd_lib.generation.rollout import MotionGenerator",
        "from f3amd_lib.training.checkpoints import load_model",
        "",
        f'generator = MotionGenerator(load_model("{path.name}"), num_steps=8)',
        "```",
        "",
    ]
    return "\n".join(lines)


def checksums(folder: Path) -> str:
    """Return lines for `sha256sum --check` of all weights below a folder."""
    folder = Path(folder)
    files = sorted(folder.glob("*/*.safetensors"))
    return "".join(
        f"{hashlib.sha256(file.read_bytes()).hexdigest()}  {file.relative_to(folder).as_posix()}\n" for file in files
    )


def committed_quality(dataset: str) -> pd.DataFrame | None:
    """Return what is on record for the models of a data set, with the weights of each row.

    Means and intervals of the protocol, and of `measure walking` (its intervals are over seeds).
    """
    folder = repository_root() / "paper_figures" / dataset / "laptop" / "records"
    tables = []
    if (folder / "quality.csv").exists():
        table, _ = read_table(folder / "quality.csv")
        by_seed, _ = read_table(folder / "quality_by_seed.csv")
        keys = ["model", "window_frames", "steps"]
        weights = by_seed[[*keys, "weights"]].drop_duplicates(keys)
        tables.append(table.merge(weights, on=keys, how="left"))
    if (folder / "walking.csv").exists():
        tables.append(_walking_rows(read_table(folder / "walking.csv")[0]))
    return pd.concat(tables, ignore_index=True) if tables else None


def _walking_rows(walking: pd.DataFrame) -> pd.DataFrame:
    """Sum `records/walking.csv` up in the form of the protocol's table."""
    rows = []
    figures = [name for name in CARD_FIGURES if name in walking and name != "joint_acceleration"]
    for (model, steps, weights), part in walking.fillna({"weights": ""}).groupby(
        ["model", "steps", "weights"], sort=False
    ):
        means = part.groupby("seed")[figures].mean()
        half = 1.96 * means.std(ddof=1) / len(means) ** 0.5  # NaN for one seed
        for name in figures:
            value = means[name].mean()
            interval = {"low": value - half[name], "high": value + half[name]}
            rows.append({"metric": name, "value": value, **interval})
            rows[-1] |= {"model": model, "steps": steps, "weights": weights}
    return pd.DataFrame(rows).assign(window_frames=32)


def write_cards(folder: Path = PRETRAINED_DIR) -> list[Path]:
    """Write the card beside every weights file below a folder, and `checksums.txt`.

    Args:
      folder: with a folder for each data set.

    Returns:
      The cards.
    """
    folder = Path(folder)
    cards = []
    for path in sorted(folder.glob("*/*.safetensors")):
        card = path.with_suffix(".md")
        card.write_text(model_card(path, committed_quality(path.parent.name)), encoding="utf-8")
        cards.append(card)
    (folder / "checksums.txt").write_text(checksums(folder), encoding="utf-8")
    return cards


def write_readme_table(path: Path, quality: pd.DataFrame) -> None:
    """Put the table of measured figures between its two marks in README.

    Args:
      path: of README; all other text stays.
      quality: from `committed_quality`.

    Raises:
      ValueError: if the marks are not there.
    """
    text = Path(path).read_text(encoding="utf-8")
    parts = re.split(r"(<!-- measured: (?:begin|end) -->\n)", text)
    if len(parts) != 5:
        raise ValueError(f"{path}: no `<!-- measured: begin -->` and `end` line around the table")
    parts[2] = "\n" + readme_table(quality) + "\n"
    Path(path).write_text("".join(parts), encoding="utf-8")


def main() -> int:
    """Write all cards and README's table; see the module's first lines."""
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    for card in write_cards():
        log.info("%s", card)
    write_readme_table(repository_root() / "README.md", committed_quality("bandai"))
    return 0


if __name__ == "__main__":
    sys.exit(main())
