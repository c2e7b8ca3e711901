"""A paper's own table by a reader's data, evaluator and weights, with the paper's beside it: `f3amd reproduce`.

The protocol is the released one: all test clips, groups of 32, in each repeat other captions and crops. Real motion
comes first: where its figures are not the paper's, data or evaluator are not, and no other row would mean anything.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pandas as pd
from safetensors import safe_open

from f3amd_companion.measuring.runner import Records
from f3amd_companion.measuring.text_tables import BRANCHES, REAL, Bench, measure_rows
from f3amd_lib.ground import log
from f3amd_lib.ground.names import check_known
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.records import run_record, write_table
from f3amd_lib.ground.trees import weights_digest
from f3amd_lib.measures.distributions import intervals_over_repeats
from f3amd_lib.networks import presets
from f3amd_lib.papers.printed import SCHEMAS, printed_tables
from f3amd_lib.text.data.humanml3d import read_humanml3d
from f3amd_lib.text.data.redundant import essential_features, redundant_from_positions
from f3amd_lib.text.data.text_encoders import TextEncoder, embed_captions, load_text_encoder
from f3amd_lib.text.data.text_motions import UNIT, TextMotions
from f3amd_lib.text.judge import text_metrics
from f3amd_lib.text.judge.text_judge import TextJudge, text_figures
from f3amd_lib.text.released import FAMILIES, read_released, released_encoder
from f3amd_lib.text.stages.text_models import CONTROL, load_text_model

EVALUATORS = {"acmdm": "acmdm-evaluator", "motionpcm": "evaluator"}
"""Paper -> family of the evaluator that its figures are of, and name of its file."""

CLIP_EVALUATOR = "acmdm-clip-evaluator"
"""The one of ACMDM's CLIP-score, where it lies beside the other."""

REAL_ROWS = {"acmdm": "text_table2", "motionpcm": "text_pcm1"}
"""Paper -> the table of ours that has its row of real motion."""

CHECKED = ("R_precision_3", "matching_distance")
"""Figures of real motion that say whether data and evaluator are the paper's."""

ENCODERS = {"acmdm": "clip", "motionpcm": "t5"}
"""Paper -> what embeds its models' captions."""

HOURS = {"acmdm": "; 8 hours of an RTX 4090 for S-PS22, two days of an H200 for XL-PS2", "motionpcm": ""}
"""Paper -> what it says of the time."""

DATASETS = {"humanml3d": "HumanML3D", "kit": "KIT-ML"}
"""Layout -> its name in the papers' tables."""

NO_MESHES = (
    "Table 4 needs SMPL-H meshes of HumanML3D's clips and an autoencoder of them: neither the data set nor the release "
    "has them, and none is read here; `f3amd measure text_table4` measures a body of ours"
)


# ------------------------------------------------------------------------------------------------------------ protocol


@dataclass(frozen=True)
class PaperBench(Bench):
    """A bench of the released protocol: `encoder` is of the models; of `real`, whole clips, each repeat sees crops.

    Attributes:
      heard: the judge's vectors of captions, [N, D]; all captions were embedded once.
      pooled: the encoder's, [N, W]; None where no model is asked.
      clip: judge of the CLIP-score and its vectors of captions; None leaves it out.
    """

    heard: Callable[[list[str]], np.ndarray]
    pooled: Callable[[list[str]], np.ndarray] | None = None
    clip: tuple[TextJudge, Callable[[list[str]], np.ndarray]] | None = None

    @property
    def vectors(self) -> bool:
        """Whether the judge sees vectors: ACMDM's makes the essential ones of positions itself."""
        return self.judge.config.features > 4 + 3 * (self.real.skeleton.num_joints - 1)

    def repeated(self) -> list[PaperBench]:
        """Return the benches of all repeats."""
        return [self.at(repeat) for repeat in range(self.settings["repeats"])]

    def at(self, repeat: int) -> PaperBench:
        """Return the bench of one repeat: clips in another order, each cropped as the released readers crop it.

        Lengths are multiples of 4, every third a unit shorter; where a crop begins is drawn.
        """
        generator = np.random.default_rng([self.seed, repeat])
        real = self.real.select(generator.permutation(self.real.num_clips))
        lengths = real.lengths // UNIT * UNIT - UNIT * (generator.random(real.num_clips) < 1 / 3)
        begin = generator.integers(real.lengths - lengths + 1)
        rows = np.concatenate([np.arange(length) for length in lengths]) + np.repeat(real.start[:-1] + begin, lengths)
        stored = tuple((file, first + more) for (file, first), more in zip(real.stored, begin, strict=True))
        crops = {"positions": real.positions[rows], "start": np.cumsum([0, *lengths]), "stored": stored}
        return replace(self, real=replace(real, **crops), seed=self.seed + repeat)

    def pool(self, told: list[str]) -> np.ndarray | None:
        """Return the embeddings of captions, [N, W], where a model is asked."""
        return self.pooled and self.pooled(told)

    def shown(self) -> list[np.ndarray]:
        """Return what the judge sees of the real clips."""
        return np.split(self.real.redundant_vectors() if self.vectors else self.real.positions, self.real.start[1:-1])

    def embed(self, motions) -> np.ndarray:
        """Return vectors [L, C] as they are, or positions [L, J, 3], of which the released code makes L - 1 vectors."""
        return _embedded(self.judge, self.real, motions)

    def _seen(self, system, repeats: int) -> pd.DataFrame:
        motions, told = system(0)
        seen, real = self.embed(motions), self.embed(self.shown())
        drawing, group = np.random.default_rng([self.seed, 1]), min(self.settings["group"], len(told))
        figures = text_figures(self.heard(told), seen, real, self.real.pairs, drawing, group)
        del figures["CLIP_score"]  # this judge's is not the paper's
        if self.clip:
            judge, heard = self.clip
            figures["CLIP_score"] = text_metrics.clip_score(heard(told), _embedded(judge, self.real, motions))
        if np.ndim(motions[0]) == 3:
            skating = [text_metrics.foot_skating_ratio(self.real.skeleton, one, self.real.fps) for one in motions]
            figures["foot_skating"] = np.mean(skating)
        return pd.DataFrame(figures.items(), columns=["metric", "value"])


def _embedded(judge: TextJudge, real: TextMotions, motions) -> np.ndarray:
    essential = judge.config.features == 4 + 3 * (real.skeleton.num_joints - 1)
    of = essential_features if essential else redundant_from_positions
    return judge.embed_vectors([of(real.skeleton, one) if np.ndim(one) == 3 else one for one in motions])


def looked_up(captions: list[str], vectors: np.ndarray) -> Callable[[list[str]], np.ndarray]:
    """Return what gives the vectors of some of the captions, by their words."""
    place = {caption: row for row, caption in enumerate(captions)}
    return lambda told: vectors[[place[caption] for caption in told]]


def evaluator_in(folder: Path, family: str, source: Path, data: TextMotions, layout: str):
    """Read a published evaluator; return it and its vectors of the captions of a data set's clips."""
    encoder = released_encoder(family, folder, source)
    file = Path(folder) / f"{family}.safetensors"
    judge = read_released(file, family, statistics=folder, encoder=encoder, layout=layout)
    captions = captions_of(data)
    return judge, looked_up(captions, judge.embed_texts(embed_captions(captions, encoder)))


def captions_of(data: TextMotions) -> list[str]:
    """Return each caption once."""
    return sorted({caption for said in data.captions for caption in said})


def real_figures(bench: PaperBench) -> pd.DataFrame:
    """Return the figures of real motion; its FID is to itself, so 0, and left out."""
    tables = [one.quality(lambda *asked, one=one: one.shown()) for one in bench.repeated()]
    table = intervals_over_repeats(pd.concat(tables), ["metric"])
    return table[~table["metric"].isin(["text_FID", "foot_skating"])]


# ------------------------------------------------------------------------------------------------------------- verdicts


def verdict(paper, ours) -> str:
    """Compare two figures, each (low, value, high), bounds NaN where nothing was repeated.

    Returns:
      "within" where the intervals meet, "higher" or "lower" of ours where they do not, "no interval" where neither has
      one, "not printed" or "not measured".
    """
    if np.isnan(paper[1]) or np.isnan(ours[1]):
        return "not printed" if np.isnan(paper[1]) else "not measured"
    if np.isnan([paper[0], ours[0]]).all():
        return "no interval"
    (low, _, high), (least, _, most) = (np.nan_to_num(one, nan=one[1]) for one in (paper, ours))
    return "higher" if least > high else "lower" if most < low else "within"


def beside_paper(printed: pd.DataFrame, measured: pd.DataFrame, keys: list[str]) -> pd.DataFrame:
    """Return each printed figure, ours beside it and the verdict; seconds are of a device, and have none."""
    columns = ["low", "value", "high"]
    named = {whose: {column: f"{whose}: {column}" for column in columns} for whose in ("paper", "yours")}
    both = [table.reindex(columns=[*keys, *columns]).rename(columns=named[whose])
            for whose, table in zip(named, (printed, measured), strict=True)]  # fmt: skip
    table = both[0].merge(both[1], on=keys, how="left")
    table["verdict"] = list(map(verdict, *[table[list(names.values())].to_numpy(float) for names in named.values()]))
    table["yours / paper"] = table["yours: value"] / table["paper: value"]
    return table.assign(verdict=table["verdict"].mask(table["metric"] == "sampling_seconds", "of a device"))


# --------------------------------------------------------------------------------------------------------------- models


def family_of(name: str) -> str:
    """Return the family of released weights that a preset's are, perhaps with a branch behind it."""
    base, control, _ = name.partition(CONTROL)
    if control:
        return "acmdm-control"
    alike = [family for family, told in FAMILIES.items() if told.get("preset") == base]
    return alike[0] if alike else "acmdm"


def model_in(folder: Path, name: str, encoder: TextEncoder, layout: str):
    """Read a preset's weights: a file of ours (`f3amd convert`, `f3amd train`) or arrays as they were released."""
    file = Path(folder) / f"{name}.safetensors"
    with safe_open(file, framework="numpy") as opened:
        own = "description" in (opened.metadata() or {})
    if own:
        trained = load_text_model(file)
        if trained.config and trained.text_encoder != encoder.identity:
            raise ValueError(f"{file}: reads captions of {trained.text_encoder}, not of {encoder.identity}")
        return trained
    found = presets.find_preset(name.partition(CONTROL)[0])
    coder = Path(folder) / f"{found.latent}.safetensors" if found.latent else None
    options = {"preset": name, "statistics": folder, "autoencoder": coder, "layout": layout}
    return read_released(file, family_of(name), encoder=encoder, **options)


def rows_of(name: str, printed: pd.DataFrame) -> list[dict]:
    """Return the rows of a printed table that are models of ours, as `measure_rows` takes them."""
    keys = [key for key in SCHEMAS[name] if key not in ("metric", "joint")]
    rows = printed.loc[printed["model"].isin(presets.PRESETS), keys].drop_duplicates().to_dict("records")
    for row in rows:
        row["trained"] = row["model"]
        if row["model"].endswith("-prefix") and row["first_prefix"] == "generated":
            row["first"] = "ACMDM-S-PS22"
    return rows


# --------------------------------------------------------------------------------------------------------------- table


@dataclass(frozen=True)
class Sources:
    """What a reader has fetched or trained.

    Attributes:
      data: folder of HumanML3D or KIT-ML.
      evaluator: folder of the published evaluator's arrays, statistics and words.
      weights: folder of models, each named by its preset; None measures real motion alone.
      text_encoder, text_weights: of the models; by default the paper's own.
    """

    data: Path
    evaluator: Path
    weights: Path | None = None
    text_encoder: str | None = None
    text_weights: Path | None = None


def check_real(paper: str, printed: pd.DataFrame, measured: pd.DataFrame) -> bool:
    """Say how real motion compares with a paper's row of it, and return whether data and evaluator are right."""
    table = beside_paper(printed[printed["metric"].isin(CHECKED)], measured, ["metric"])
    for row in table.to_dict("records"):
        figures = {whose: row[f"{whose}: value"] for whose in ("paper", "yours")}
        log.info("real motion  %s: %s", row["metric"], "{paper:.3f} printed, {yours:.3f} here".format(**figures))
    right = bool(len(table)) and bool((table["verdict"] == "within").all())
    if not right:
        why = "is off by more than its interval: data, evaluator or its statistics are not the paper's"
        log.warning("%s: real motion %s", paper, why if len(table) else "is printed for no such data set")
    return right


def reproduce_table(
    paper: str, number: str, given: Sources, *, out: Path, repeats: int | None = None, seed: int = 0,
    stop_at: float | None = None,
) -> Path | None:  # fmt: skip
    """Measure a printed table by the released protocol, real motion first, then the rows that have weights.

    Args:
      paper, number: acmdm or motionpcm, and the table's number; ACMDM's 3, A2 and A4 are one.
      given: what is there.
      out: folder of the records, with which a stopped run goes on row by row.
      repeats: instead of 20.
      seed: of captions, crops and noise.
      stop_at: do not begin a row after this time (`time.monotonic`).

    Returns:
      Beside the paper's, `<out>/<humanml3d or kit>/<name>_beside_paper.csv`; None where the time was over first.

    Raises:
      ValueError: for a table that cannot be measured, or what is missing or broken among the files.
    """
    records_of = {entry["number"]: entry["record"] for entry in load_paper_file("paper", paper)["table"]}
    check_known(number, records_of, f"table of {paper}")
    name, experiments = records_of[number], load_paper_file("experiments", paper)
    about = experiments.get(name, {"kind": "whole"})
    if about["kind"] == "mesh":
        raise ValueError(NO_MESHES)
    data = read_humanml3d(given.data)
    layout = "kit" if data.skeleton.num_joints == 21 else "humanml3d"
    out = out / layout
    if (layout == "kit") != (name == "text_tableA3") and paper == "acmdm":
        raise ValueError(f"{given.data}: has the layout {layout}; Table A3 needs KIT-ML, the others HumanML3D")
    settings = load_paper_file("experiments", "acmdm")["settings"]["paper"] | ({"repeats": repeats} if repeats else {})
    if about["kind"] == "control":
        settings["repeats"] = 1  # as released
    elif about["kind"] != "autoregressive":
        settings["num_steps"] = None  # the release's own solver
    test = data.select(data.members("test"))
    judge, heard = evaluator_in(given.evaluator, EVALUATORS[paper], given.data, test, layout)
    extra = paper == "acmdm" and (given.evaluator / f"{CLIP_EVALUATOR}.safetensors").is_file()
    clip = evaluator_in(given.evaluator, CLIP_EVALUATOR, given.data, test, layout) if extra else None
    record = run_record(
        profile="paper", dataset=data, seed=seed, measurement=f"{paper} {name}", settings=settings,
        judge_weights=weights_digest([judge.params, judge.normaliser]), judge_encoder=judge.text_encoder,
        text_encoder=given.text_encoder or ENCODERS[paper], clip_weights=weights_digest(clip[0].params) if clip else "",
    )  # fmt: skip
    bench = PaperBench(judge, None, test, settings, seed, heard, clip=clip)
    of_data = lambda table: table[table["dataset"] == DATASETS[layout]] if "dataset" in table else table
    printed, keys = of_data(printed_tables(paper)[name]), [key for key in SCHEMAS[name] if key != "metric"]
    real = Records(out, record, {f"{name}_real": ["model"]})
    real.measure([{"model": REAL}], lambda row: {f"{name}_real": real_figures(bench)})
    real = real.tables[f"{name}_real"].drop(columns="model")
    known = of_data(printed_tables(paper)[REAL_ROWS[paper]])
    check_real(paper, known[(known["model"] == REAL) & (name != "text_tableA3")], real)
    rows = [row for row in rows_of(name, printed) if _ready(paper, row, given)]
    if rows and about["kind"] != "reconstruction":
        encoder = load_text_encoder(given.text_encoder or ENCODERS[paper], given.text_weights)
        captions = captions_of(test)
        bench = replace(bench, encoder=encoder, pooled=looked_up(captions, embed_captions(captions, encoder).pooled))
    tables = dict.fromkeys((name, *about.get("beside", ())), [key for key in keys if key != "joint"])
    records = Records(out, record, tables)
    find = lambda preset: model_in(given.weights, preset, bench.encoder, layout)
    over = bool(rows) and measure_rows(name, rows, about, records, bench, find, stop_at) is None
    of_real = printed.loc[printed["model"].isin([REAL, "GT"]), keys].drop_duplicates()
    found = [real.merge(of_real, how="cross"), *([records.tables[name]] if records.tables[name] is not None else [])]
    table = beside_paper(printed, pd.concat(found), SCHEMAS[name])
    path = write_table(out / f"{name}_beside_paper.csv", table, record)
    return None if over else path


def _ready(paper: str, row: Mapping, given: Sources) -> bool:
    """Return whether a row's weights are there; say what is missing, or which training of one's own makes it."""
    names = [row["trained"] + BRANCHES.get(row.get("section"), ""), *([row["first"]] if "first" in row else [])]
    lacking = [name for name in names if not (given.weights and (given.weights / f"{name}.safetensors").is_file())]
    for name in lacking:
        of_paper = load_paper_file("paper", paper)["training"]["says"] + HOURS[paper]
        log.info("no weights   %s.safetensors: convert released ones, or train your own (%s) with", name, of_paper)
        log.info("             f3amd train --preset %s --profile gpu --data folder --source %s --text-encoder %s",
                 name, given.data, given.text_encoder or ENCODERS[paper])  # fmt: skip
    return not lacking
