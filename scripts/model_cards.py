"""A card for every model that ships: what it is, its data, how well it does, its limits.

    python scripts/model_cards.py  # writes cards, checksums and the table of docs/results.md

Everything on a card is read from the weights file and from committed results; nothing is typed in.
"""

from __future__ import annotations

import argparse
import hashlib
import re
import sys
from collections.abc import Mapping, Sequence
from pathlib import Path

import optax
import pandas as pd
from page_tables import fill_tables

sys.path.insert(0, str(Path(__file__).resolve().parents[1]))  # this tree's library, whatever is installed

from f3amd_notebooks.quality_tables import committed_quality

from f3amd_lib.ground.files import read_toml, write_whole
from f3amd_lib.ground.names import counted_cores
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.records import committed_table, read_table
from f3amd_lib.ground.tables import figure_text, markdown_table
from f3amd_lib.ground.trees import describe, weights_digest
from f3amd_lib.measures.registry import METRICS, SHOWN, Metric
from f3amd_lib.papers.printed import SCHEMAS
from f3amd_lib.text.judge.text_judge import load_judge
from f3amd_lib.text.stages.text_models import JUDGE, is_latent_preset, load_text_model
from f3amd_lib.training.checkpoints import load_model
from f3amd_lib.training.pipeline import PRETRAINED_DIR

ROOT = Path(__file__).resolve().parents[1]
_FOLDER = ROOT / "scripts" / "cards"
_CARDS = read_toml(_FOLDER / "limits.toml")
_OF_HANDS = ["motions", "asked_hand", "other_hand", "both_hands", "no_hand"]
_OF_JUDGE = ["text_FID", "R_precision_1", "R_precision_3", "matching_distance"]


MEASURED_COLUMNS = pd.read_csv(_FOLDER / "results_columns.csv")
"""Headings of the columns of docs/results.md, with their model and steps."""


def measured_table(quality: pd.DataFrame, window: int = 32) -> str:
    """Render the table of what was measured on real motion, our own figures alone.

    Args:
      quality: from `protocol.summarise`.
      window: of the models, frames.

    Returns:
      Markdown: means with 95 % intervals; a figure that a column does not have is a dash.
    """
    own = quality[quality["window_frames"] == window]
    shown = SHOWN["results"]
    columns = {"": ["style coverage (%)" if metric.name == "style_coverage" else metric.title for metric in shown]}
    for title, model, steps in MEASURED_COLUMNS.itertuples(index=False):
        columns[title] = figure_column(own[(own["model"] == model) & (own["steps"] == steps)], shown, fixed=True)
    return markdown_table(pd.DataFrame(columns))


def figure_column(rows: pd.DataFrame, metrics: Sequence[Metric], *, fixed: bool = False) -> list[str]:
    """Write metrics of one system, a dash for one that it lacks.

    Args:
      rows: tidy, the system's own: metric, value, low, high. Of two of one metric the first counts.
      metrics: which, in this order.
      fixed: each with as many decimals as the registry says, in place of four digits.
    """
    figures = rows.drop_duplicates("metric").set_index("metric")[["value", "low", "high"]]
    figures = figures.reindex([metric.name for metric in metrics]).to_numpy()
    return [figure_text(*figure, metric.decimals if fixed else None)
            for metric, figure in zip(metrics, figures, strict=True)]  # fmt: skip


def _figures(measured: pd.DataFrame, real: pd.DataFrame) -> pd.DataFrame:
    """Return the table of a model's figures beside real motion's."""
    shown = SHOWN["card"]
    titles = ["Dir. (degrees)" if metric.name == "direction_error" else metric.title for metric in shown]
    systems = {f"{steps} steps" if steps > 1 else "1 step": rows for steps, rows in measured.groupby("steps")}
    systems = dict(reversed(systems.items())) | {"real motion": real}
    return pd.DataFrame({"figure": titles} | {name: figure_column(rows, shown) for name, rows in systems.items()})


def _wide(rows: pd.DataFrame, index: str, metrics: list[str]) -> pd.DataFrame:
    """Spread figures to a line for each value of `index`, a column for each of the metrics that there are."""
    wide = rows.pivot(index=index, columns="metric", values="value").loc[rows[index].unique()]
    titles = {name: METRICS[name].title for name in metrics if name in wide}
    return wide[list(titles)].rename(columns=titles).reset_index()


def _limits(measured: pd.DataFrame, real: pd.DataFrame) -> list[str]:
    """Return sentences on what a model does badly with most steps, as far as its figures say so."""
    most, limits = measured[measured["steps"] == measured["steps"].max()], []
    both = pd.DataFrame({name: rows.set_index("metric")["value"] for name, rows in (("value", most), ("real", real))})
    for limit in _CARDS["limit"]:
        found = both.reindex([limit["metric"]]).iloc[0]  # what was not measured is NaN, and beyond no bound
        over = found["value"] / (limit["bound"] * (found["real"] if limit.get("of_real") else 1.0))
        if over > 1.0 if limit["sign"] == ">" else over < 1.0:
            limits.append(limit["says"].format(**found))
    return limits


def _filled(name: str, path: Path, trained, params, measured: pd.DataFrame | None, **fields) -> str:
    """Fill the template of a card: `fields`, and what all cards say of a file, its weights and its training."""
    record, says = trained.record, _CARDS["measured" if measured is not None else "unmeasured"][name]
    non_commercial = "NC" in re.split(r"[\s-]+", record["dataset_licence"])
    return (_FOLDER / f"{name}.template").read_text(encoding="utf-8").format(
        trained=trained, record=record, file=path.name, megabytes=path.stat().st_size / 1e6,
        count=optax.tree.size(params),
        weights_type=describe(path).get("weights", "bfloat16"), date=record["date_utc"][:10],
        terms=": **non-commercial use only**" if non_commercial else "",
        commit=(record["git_commit"] or "unknown")[:10],
        tree=" from a work tree with uncommitted changes" if record["git_dirty"] else "",
        measured=says if measured is None else says.format(table=markdown_table(measured), **fields),
        cores=counted_cores(record), **fields,
    )  # fmt: skip


def _training(path: Path, trained, recipe: Mapping, paper: str = "") -> dict:
    """Return what a card says of a training: how many examples it saw, in how many steps, and its last held-out loss.

    Args:
      path: the weights, with the history beside them.
      trained: the model.
      recipe: of its run.
      paper: of a model of text to motion, beside whose training its own is told.
    """
    record = trained.record
    examples, data = ("motions_seen", "num_train_clips") if paper else ("windows_seen", "num_train_windows")
    # A model may be trained in several legs, of which the recipe is the last's.
    seen, legs = record.get(examples, recipe["num_steps"] * recipe["batch_size"]), record.get("schedule_note")
    loss = read_table(path.with_name(f"{path.stem}.history.csv"))[0]["held_out_loss"].dropna().iloc[-1]
    fields = {"recipe": recipe, "loss": loss, "seen": seen}
    fields |= {"legs": f" ({legs})" if legs else "", "last": " in the last part" if legs else ""}
    fields |= {"steps": seen // recipe["batch_size"], "passes": seen / record[data]}
    if paper:
        about = load_paper_file("paper", paper)["training"]
        fields |= {"paper": about["says"], "share": 100 * seen / about["windows"]["text"]}
        fields |= {"seconds": trained.most_frames / trained.fps, "words": len(trained.words)}
    return fields


def model_card(path: Path, quality: pd.DataFrame | None) -> str:
    """Write the card of one weights file.

    Args:
      path: the weights.
      quality: from `committed_quality`, or None; rows of other weights are not used.
    """
    trained = load_model(path)
    training, figures, limits = _training(path, trained, trained.record["training"]), None, []
    if quality is not None:
        own = (quality["model"] == trained.name) & (quality["weights"] == weights_digest(trained.params))
        real = quality[quality["model"] == "real"]
        if own.any():
            figures, limits = _figures(quality[own], real), _limits(quality[own], real)
    limits.append("It knows the walks, runs and styles of its data, on level ground, and no others.")
    whole = load_paper_file("paper")["training"]["windows"].get(str(trained.config.window))
    if whole and training["seen"] < whole:
        limits.append(f"It saw {100 * training['seen'] / whole:.2g} % of the windows that the paper's models saw.")
    told = {"styles": ", ".join(trained.styles), "limits": "\n".join(f"- {limit}" for limit in limits)}
    return _filled("model_card", path, trained, trained.params, figures, **training, **told)


def text_model_card(path: Path, hands: pd.DataFrame | None) -> str:
    """Write the card of a model of text to motion.

    Args:
      path: the weights.
      hands: `records/hands.csv`, or None; rows of other weights are not used.
    """
    trained = load_text_model(path)
    record, codec, counts = trained.record, trained.codec, None
    if hands is not None and (own := hands["weights"] == weights_digest(trained.params)).any():
        shown = hands[own | (hands["model"] == "real clips")].fillna({"wording": "clips"})
        counts = shown.groupby(["model", "wording"], sort=False)[_OF_HANDS].sum().reset_index()
        counts.columns = counts.columns.str.replace("_", " ")
    state = "positions of joints" + (" and redundant features" if codec.redundancy else "")
    if codec.frames_per_state > 1:
        state = f"latent of {codec.autoencoder.latent_channels} numbers a joint, four frames at a time"
    elif codec.mesh:
        state = f"latent of a body's mesh, {trained.config.num_joints} vertices of {trained.config.channels} numbers"
    fields = _training(path, trained, record["identity"]["training"], "acmdm") | {"state": state}
    fields["guidance"] = f"{record['guidance']:g}" if "guidance" in record else "the paper's 3"
    return _filled("text_model_card", path, trained, (trained.params, codec.params), counts, **fields)


def latent_model_card(path: Path, tables: Mapping[str, pd.DataFrame]) -> str:
    """Write the card of a model of MotionPCM.

    Args:
      path: the weights.
      tables: `records/text_pcm*.csv` by name, those that there are.
    """
    trained, wide = load_text_model(path), None
    digest = weights_digest(trained.params)
    rows = [table[table["weights"] == digest] for table in tables.values() if "steps" in table]
    movement = "What its autoencoder keeps of the movement of real clips was not measured"
    if any(map(len, rows)):
        own = pd.concat(rows).drop_duplicates(["steps", "metric"]).sort_values("steps")
        if len(kept := own[own["metric"] == "kept_movement"]):
            share = 100 * kept["value"].iloc[0]
            movement = f"Its autoencoder keeps {share:.1f} % of the movement of real clips (variance over frames)"
        own["value"] = own["value"].map("{:.3g}".format, na_action="ignore")
        wide = _wide(own, "steps", [*_OF_JUDGE, "sampling_seconds"]).fillna("–")
    phases, is_student = trained.training["num_phases"], bool(trained.config.guidance_features)
    what = f"student of {phases} step{'s' * (phases > 1)}" if is_student else "teacher, sampled by DDIM"
    latent = f"{trained.autoencoder.window} x {trained.autoencoder.channels}"
    fields = _training(path, trained, trained.training, "motionpcm") | {"what": what, "latent": latent}
    params = (trained.params, trained.autoencoder_params)
    return _filled("latent_model_card", path, trained, params, wide, **fields, movement=movement)


def judge_card(path: Path, seen: tuple[pd.DataFrame, dict] | None) -> str:
    """Write the card of a judge of text to motion.

    Args:
      path: its file.
      seen: `records/text_judge.csv` with its record, or None; figures of another judge are not used.
    """
    judge, wide, fields = load_judge(path), None, {}
    digest = weights_digest(judge.params)
    if seen is not None and seen[1]["judge_weights"] == digest:
        wide = _wide(seen[0].round({"value": 9}), "system", _OF_JUDGE)
        fields = {"repeats": seen[1]["settings"]["repeats"]}
    return _filled("judge_card", path, judge, judge.params, wide, digest=digest, **fields)


def card_of(path: Path) -> str:
    """Return the card of a shipped file, `<data set>/NAME` or `<data set>/text/NAME`, from committed results."""
    if path.parent.name != "text":
        return model_card(path, committed_quality(path.parent.name))
    dataset = path.parent.parent.name
    if path.stem == JUDGE:
        return judge_card(path, committed_table(dataset, "text_judge"))
    if is_latent_preset(path.stem):
        found = {name: committed_table(dataset, name) for name in SCHEMAS if name.startswith("text_pcm")}
        return latent_model_card(path, {name: one[0] for name, one in found.items() if one})
    hands, _ = committed_table(dataset, "hands") or (None, None)
    return text_model_card(path, hands)


def write_cards(folder: Path = PRETRAINED_DIR) -> list[Path]:
    """Write the card beside every weights file below a folder, and `checksums.txt`, lines for `sha256sum --check`.

    Args:
      folder: with a folder for each data set.

    Returns:
      The cards.
    """
    weights = sorted(folder.rglob("*.safetensors"))
    digests = {path.relative_to(folder).as_posix(): hashlib.sha256(path.read_bytes()).hexdigest() for path in weights}
    write_whole(folder / "checksums.txt", "".join(f"{digest}  {name}\n" for name, digest in digests.items()))
    return [write_whole(path.with_suffix(".md"), card_of(path)) for path in weights]


if __name__ == "__main__":
    argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter).parse_args()
    for card in write_cards():
        print(card)
    page = ROOT / "docs" / "results.md"
    table = measured_table(committed_quality("bandai"))
    write_whole(page, fill_tables(page.read_text(encoding="utf-8"), {"measured": table}, str(page)))
