"""The claims ledger: what a paper says, judged from records. `scripts/claims_page.py` writes the pages.

Every claim is an entry of the paper's `claims.toml`: its sentence in our words, its place in the
paper, what decides it, and its statements, each with its kind of judgement. A verdict
follows from recorded figures alone, and from none of ours to none of the paper's: models of our own
(`-plus`, `-steady`, `-raw`, ...) decide nothing. The same statements are judged from the paper's own tables,
which do not always say what its text says.

The verdicts are committed. When a new measurement changes one, a test fails until somebody has
looked at it and accepts the change on purpose (`scripts/claims_page.py --accept`).
"""

from __future__ import annotations

import functools
import inspect
import json
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import pandas as pd

from f3amd_companion.ledger import judgements as judging
from f3amd_companion.ledger import theory
from f3amd_companion.ledger.evidence import (
    TIMES,
    Evidence,
    Network,
    NotMeasured,
    check_model,
    paper_evidence,
    recorded_evidence,
    snapshot_evidence,
)
from f3amd_companion.ledger.gate import why_not_judged
from f3amd_lib.ground.papers import check_entry, find_entry, load_paper_file
from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.measures.registry import METRICS
from f3amd_lib.papers.printed import SCHEMAS

DATASET_ORDER = ("bandai", "synthetic", "folder")
"""Whose records decide: Bandai's motion first; CAMDM's published weights walk on a folder alone. All
statements of a claim come from one data set, but for times, which another may have taken on another device."""

PROFILE_ORDER = ("gpu", "laptop")
"""Within a data set, where a figure is looked for first. Smoke runs decide nothing."""

MARKS = dict(zip(judging.VERDICTS, "✓±>✗≈○", strict=False)) | {judging.REMARK: "·"}
"""Verdict -> its mark on pages."""

_KINDS = {
    name: function
    for module in (judging, theory)
    for name, function in inspect.getmembers(module, inspect.isfunction)
    if function.__annotations__.get("return") == judging.Finding and name[0] != "_"
}
"""Kind of judgement, as `claims.toml` names it -> function of the evidence and the statement's parameters."""


@dataclass(frozen=True)
class Statement:
    """A part of a claim, and what some evidence says of it.

    Attributes:
      says: the sentence, in our words.
      rule: its kind of judgement with its parameters, from evidence to verdict and figure.
      optional: not counted where it was not measured.
      remark: it decides nothing.
      verdict: of `VERDICTS`; "" for a remark, and before it is judged.
      figure: what was found, or why nothing was.
      reasons: why no verdict is drawn from it -> the models of which that is true.
      sources: tables behind it, `evidence.Source`.
      networks: trained ones that it looked up.
      known: how much evidence knows of it: 3 for a verdict, 2 for figures without one, less for a gap (`NotMeasured`).
    """

    says: str
    rule: Callable[[Evidence], judging.Finding]
    optional: bool = False
    remark: bool = False
    verdict: str = judging.REMARK
    figure: str = ""
    reasons: Mapping[str, Sequence[str]] = field(default_factory=dict)
    sources: tuple = ()
    networks: tuple[Network, ...] = ()
    known: int = 0

    def judge(self, evidence: Evidence) -> Statement:
        """Return the statement as this evidence has it, without a verdict where that were unsound (`ledger.gate`)."""
        evidence.forget()
        try:
            verdict, figure = self.rule(evidence)
        except NotMeasured as gap:
            return replace(self, verdict=judging.UNMEASURED, figure=str(gap), known=gap.known)
        networks = tuple(dict.fromkeys(evidence.networks))
        reasons = {} if self.remark else why_not_judged(evidence, self.rule, verdict, networks)
        verdict = judging.REMARK if self.remark else judging.UNJUDGED if reasons else verdict
        found = {"reasons": reasons, "networks": networks, "known": 2 if reasons else 3}
        return replace(self, verdict=verdict, figure=figure, sources=tuple(dict.fromkeys(evidence.sources)), **found)


@dataclass(frozen=True)
class Claim:
    """A claim of a paper.

    Attributes:
      paper: its folder.
      group: what the claim is about.
      id: first letter of the group, and a number.
      text: what is claimed, in our words.
      where: sections and tables of the paper.
      decided_by: the quantity that decides it.
      statements: its parts, not judged yet.
      paper_says: the paper's figure, if it names one.
      computed: the library decides it by computing, without records.
    """

    paper: str
    group: str
    id: str
    text: str
    where: str
    decided_by: str
    statements: tuple[Statement, ...]
    paper_says: str = ""
    computed: bool = False

    def judge(self, evidence: Evidence) -> list[Statement]:
        """Return its statements as this evidence has them."""
        return [statement.judge(evidence) for statement in self.statements]


# ------------------------------------------------------------------------------------- the paper's file

_MODELS = ("model", "models", "against", "slow", "fast", "over", "under")


def _read_models(value, families: Mapping, where: str) -> dict | list[dict]:
    """Return a model, or several, as rows of a table; a family as lists of them."""
    if isinstance(value, list):
        return [_read_models(item, families, where) for item in value]
    value = {"window": 32, "steps": 8} | ({"model": value} if isinstance(value, str) else value)
    if "family" in value:
        family = find_entry(families, value["family"], "family", where)
        member = lambda name: _read_models({"model": name, "window": value["window"]}, {}, where)
        return {key: list(map(member, names)) for key, names in family.items()}
    check_entry(value, where, ("model", "window", "steps"), ("framework",))
    check_model(value["model"], where)
    return {"model": value.pop("model"), "window_frames": value.pop("window"), "steps": value.pop("steps")} | value


def _read_statement(entry: Mapping, about: Mapping, where: str) -> Statement:
    where = f"{where}, {entry.get('says')!r}"
    check_entry(entry, where, ("says", "kind"), entry)
    kind = find_entry(_KINDS, entry["kind"], "kind of judgement", where)
    parameters = {key: value for key, value in entry.items() if key not in ("says", "kind", "optional", "remark")}
    for key in set(_MODELS) & set(parameters):
        parameters[key] = _read_models(parameters[key], about.get("families", {}), where)
    for key, known in (("metric", METRICS), ("table", SCHEMAS)):
        if key in parameters:
            find_entry(known, parameters[key], key, where)
    number = lambda one: find_entry(about["thresholds"], one, "threshold", where) if isinstance(one, str) else one
    try:
        if key := next(filter(parameters.get, judging.RANGES), None):
            numbers = parameters.pop(key)
            bounds = judging.RANGES[key](*map(number, numbers if isinstance(numbers, list) else [numbers]))
            parameters["bounds"] = bounds
        inspect.signature(kind).bind(None, **parameters)
    except TypeError as error:
        raise ValueError(f"{where}: {error}; {kind.__name__} takes {inspect.signature(kind)}") from None
    remark = entry.get("remark", False)
    return Statement(entry["says"], functools.partial(kind, **parameters), entry.get("optional", remark), remark)


def read_claims(about: Mapping, paper: str, where: str) -> dict[str, Claim]:
    """Return the claims of a file by their ids, checked.

    Args:
      about: the file as read: groups, thresholds, families and claims.
      paper: the paper's folder.
      where: the file, for messages.

    Raises:
      ValueError: for what is missing, unknown or twice; the message says file, claim and statement.
    """
    check_entry(about, where, ("groups", "claim"), ("page", "thresholds", "families"))
    claims: dict[str, Claim] = {}
    for entry in about["claim"]:
        here = f"{where}, claim {entry.get('id')}"
        check_entry(entry, here, ("id", "text", "where", "decided_by", "statement"), ("paper_says", "computed"))
        if entry["id"] in claims or entry["id"][0] not in about["groups"]:
            raise ValueError(f"{here}: needs a unique id that begins with one of {', '.join(about['groups'])}")
        fields = {key: value for key, value in entry.items() if key != "statement"}
        fields["statements"] = tuple(_read_statement(statement, about, here) for statement in entry["statement"])
        claims[entry["id"]] = Claim(paper, about["groups"][entry["id"][0]], **fields)
    return claims


@functools.cache
def load_claims(paper: str = "f3amd") -> dict[str, Claim]:
    """Return the claims of a paper by their ids, in the order of its file; ValueError as `read_claims`."""
    return read_claims(load_paper_file("claims", paper), paper, f"{paper}/claims.toml")


# ------------------------------------------------------------------------------------------ judging


@dataclass(frozen=True)
class Judgement:
    """A claim with what our records and the paper's own tables say of it.

    Attributes:
      claim: what is judged.
      ours: statements from our records (or computed).
      paper: the same statements from the paper's tables; none for a computed claim.
      dataset: whose records decided; "" if none did.
      times_of: other data sets whose times fill gaps.
    """

    claim: Claim
    ours: tuple[Statement, ...]
    paper: tuple[Statement, ...]
    dataset: str
    times_of: tuple[str, ...] = ()

    @property
    def verdict(self) -> str:
        """The verdict of our records."""
        return judging.combine(statement.verdict for statement in self.ours)

    @property
    def paper_verdict(self) -> str:
        """The verdict of the paper's own tables."""
        return judging.combine(statement.verdict for statement in self.paper)


def _seen(statements: Iterable[Statement]) -> tuple[Statement, ...]:
    """Leave out optional statements that were not measured."""
    return tuple(s for s in statements if not (s.optional and s.verdict == judging.UNMEASURED))


def _merged(claim: Claim, evidences: Sequence[Evidence]) -> list[Statement]:
    """Take each statement from the evidence that knows most of it, of equals the first."""
    judged = zip(*(claim.judge(evidence) for evidence in evidences), strict=True)
    return [max(statements, key=lambda statement: statement.known) for statements in judged]


def judge_claim(claim: Claim, evidences: Mapping[str, Sequence[Evidence]]) -> Judgement:
    """Judge a claim.

    Args:
      claim: which.
      evidences: data set -> its evidence, at least one; the first that can decide anything decides.

    Returns:
      The judgement; where nothing was decided, with what the first data set has that says most:
      figures without a verdict, a row that is missing, or a table.
    """
    paper = _seen(claim.judge(paper_evidence(claim.paper)))
    if claim.computed:
        return Judgement(claim, paper, (), "computed")
    tried = {data: _merged(claim, some) for data, some in evidences.items()}
    dataset = max(tried, key=lambda data: max((s.known for s in tried[data] if not s.remark), default=0))
    ours, times_of = tried.pop(dataset), {}
    # Times hang on the device and hardly on the data: those of other data sets fill gaps, the first that has some.
    for data, others in tried.items():
        for place, other in enumerate(others):
            of_times = other.sources and all(source.name in TIMES for source in other.sources)
            if ours[place].verdict == judging.UNMEASURED and of_times:
                ours[place], times_of[data] = other, None
    judgement = Judgement(claim, _seen(ours), paper, dataset, tuple(times_of))
    return replace(judgement, dataset="") if judgement.verdict == judging.UNMEASURED else judgement


def judge_claims(root=None, dataset=DATASET_ORDER, profile=PROFILE_ORDER, paper: str = "f3amd") -> list[Judgement]:
    """Judge all claims from recorded results.

    Args:
      root: folder of results; `paper_figures/` of the checkout by default.
      dataset: data sets, of which the first that can decides.
      profile: of `profiles.PROFILES`, without "smoke".
      paper: whose claims.

    Returns:
      One judgement a claim, in the order of the paper's file.

    Raises:
      ValueError: for unknown names, or records that are broken or lie in the wrong folder.
    """
    root = repository_root() / "paper_figures" if root is None else Path(root)
    evidences = {}
    for data in dataset:
        snapshots = [late for name in profile for late in snapshot_evidence(root, data, name)]
        evidences[data] = [recorded_evidence(root, data, name) for name in profile] + snapshots
    return [judge_claim(claim, evidences) for claim in load_claims(paper).values()]


# ------------------------------------------------------------------------------------------ writing


def _figures(statements: Sequence[Statement]) -> str:
    """Return all figures in one line, each with a mark for its verdict; or why there are none, or no verdict."""
    gaps = [s.figure for s in statements if s.verdict == judging.UNMEASURED]
    measured = [f"{MARKS[s.verdict]} {s.figure}" for s in statements if s.verdict and s.verdict != judging.UNMEASURED]
    if not measured:
        first, *others = dict.fromkeys(gaps) or [""]
        return first + (f"; and {len(others)} more" if others else "")
    missing = [f"{len(gaps)} of {len(gaps) + len(measured)} not measured"] if gaps else []
    return "; ".join([*dict.fromkeys(reason for s in statements for reason in s.reasons), *measured, *missing])


def ledger(judgements: Sequence[Judgement]) -> pd.DataFrame:
    """Return the claims ledger as a table.

    Args:
      judgements: from `judge_claims`.

    Returns:
      One row a claim: id, group, claim, where, decided_by, verdict, ours (figures with their
      intervals, or why there are none), paper_says, paper_verdict and paper_figure (the same rule
      on the paper's own tables), dataset, hardware, record (file and the first digits of its
      SHA-256).
    """
    joined = lambda words: "; ".join(dict.fromkeys(filter(None, words)))
    label = lambda name: name + " (procedural, no real motion)" * (name == "synthetic")
    rows = []
    for each in judgements:
        claim = each.claim
        # Without a data set a remark may have looked into a table, and decided nothing.
        sources = [source for statement in each.ours for source in statement.sources if each.dataset]
        rows.append({
            "id": claim.id, "group": claim.group, "claim": claim.text, "where": claim.where,
            "decided_by": claim.decided_by, "verdict": each.verdict, "ours": _figures(each.ours),
            "paper_says": claim.paper_says, "paper_verdict": each.paper_verdict, "paper_figure": _figures(each.paper),
            "dataset": joined(map(label, (each.dataset, *each.times_of))),
            "hardware": "float64" if claim.computed else joined(source.hardware for source in sources),
            "record": joined(source.place for source in sources),
        })  # fmt: skip
    return pd.DataFrame(rows)


def scale(judgements: Sequence[Judgement]) -> str:
    """Return the heading of verdicts of ours: on what data, by networks of what size, after how much training."""
    data = dict.fromkeys(each.dataset for each in judgements if each.dataset not in ("", "computed"))
    networks = [one for each in judgements for statement in each.ours for one in statement.networks]
    ends = lambda values: " to ".join(dict.fromkeys(f"{end(values) / 1e6:.3g}" for end in (min, max)))
    span = lambda values, what: f"{ends(values)} M {what}" if values else ""
    sizes = span([one.parameters for one in networks if one.parameters > 0], "parameters")
    seen = span([one.windows for one in networks if one.windows], "motions")
    return "here: " + ", ".join(filter(None, [*data, sizes, seen]))


def _found(statement: Statement) -> str:
    """Return in one text what was found of a statement, its verdict, and why it has none."""
    if statement.verdict == judging.UNMEASURED:
        return f"{judging.UNMEASURED} ({statement.figure})"
    text = f"{statement.figure} · {statement.verdict}" if statement.verdict else statement.figure
    why = "; ".join(f"{reason}: {', '.join(models)}" for reason, models in statement.reasons.items())
    return f"{text} ({why})" if why else text


def statement_table(judgement: Judgement) -> pd.DataFrame:
    """Return the statements behind a judgement: statement, ours, the paper's tables."""
    sides = {"ours": judgement.ours, "the paper's tables": judgement.paper}
    found = pd.DataFrame({side: {one.says: _found(one) for one in some} for side, some in sides.items()}, dtype=str)
    says = {one.says: f"({one.says})" if one.remark else one.says for one in judgement.claim.statements}
    return found.reindex(list(says)).dropna(how="all").fillna("").rename(says).rename_axis("statement").reset_index()


def ledger_path(paper: str = "f3amd") -> Path:
    """Return where a paper's ledger is committed; its accepted verdicts lie beside it as JSON."""
    return repository_root() / "paper_figures" / ("claims.md" if paper == "f3amd" else f"claims_{paper}.md")


def accepted_verdicts(path: Path | None = None) -> dict[str, dict[str, str]]:
    """Read the verdicts that were accepted.

    Args:
      path: of the ledger (`.md`) beside which they lie; `paper_figures/claims.md` by default.

    Returns:
      Claim id -> verdict, figure, paper_verdict, paper_figure; empty if nothing was accepted yet.
    """
    path = (path or ledger_path()).with_suffix(".json")
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def verdicts_of(frame: pd.DataFrame) -> dict[str, dict[str, str]]:
    """Return what is accepted of a ledger, in the form of `accepted_verdicts`."""
    columns = ["verdict", "ours", "paper_verdict", "paper_figure"]
    return frame.set_index("id")[columns].rename(columns={"ours": "figure"}).to_dict("index")


def changed_verdicts(frame: pd.DataFrame, accepted: Mapping[str, Mapping[str, str]]) -> list[str]:
    """List the verdicts that are not the accepted ones, one sentence each.

    Args:
      frame: from `ledger`.
      accepted: from `accepted_verdicts`.
    """
    verdicts, sides = verdicts_of(frame), {"our records": "", "the paper's tables": "paper_"}
    changes = [
        f"{name} by {whose}: was {was!r}, is {now[f'{side}verdict']!r} ({now[f'{side}figure']})"
        for name, now in verdicts.items()
        for whose, side in sides.items()
        if (was := accepted.get(name, {}).get(f"{side}verdict", "not accepted yet")) != now[f"{side}verdict"]
    ]
    return changes + [f"{name}: is no claim any more" for name in accepted if name not in verdicts]
