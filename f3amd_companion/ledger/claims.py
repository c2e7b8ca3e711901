"""The claims ledger: what a paper says, judged from records: `f3amd claims`.

Every claim is an entry of the paper's `claims.toml`: its sentence in our words, its place in the
paper, what decides it, and its statements, each with its kind of judgement. A verdict
follows from recorded figures alone, and from none of ours to none of the paper's: models of our own
(`-plus`, `-steady`, `-raw`, ...) decide nothing. The same statements are judged from the paper's own tables,
which do not always say what its text says.

The verdicts are committed. When a new measurement changes one, a test fails until somebody has
looked at it and accepts the change on purpose (`--accept`).
"""

from __future__ import annotations

import functools
import html
import inspect
import json
import re
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path

import numpy as np
import pandas as pd

from f3amd_companion.ledger import judgements as judging
from f3amd_companion.ledger import theory
from f3amd_companion.ledger.evidence import (
    Evidence,
    Network,
    NotMeasured,
    paper_evidence,
    recorded_evidence,
    snapshot_evidence,
)
from f3amd_companion.ledger.gate import why_not_judged
from f3amd_lib.ground import log
from f3amd_lib.ground.files import read_toml, write_whole
from f3amd_lib.ground.papers import check_entry, find_entry, has_paper_file, load_paper_file, paper_folders
from f3amd_lib.ground.profiles import load_profile, repository_root
from f3amd_lib.ground.tables import compact_table, markdown_table
from f3amd_lib.measures.registry import METRICS
from f3amd_lib.papers.printed import SCHEMAS, TIMES, check_model

DATASET_ORDER = ("bandai", "synthetic", "folder")
"""Whose records decide: Bandai's motion first; CAMDM's published weights walk on a folder alone. All
statements of a claim come from one data set, but for times, which another may have taken on another device."""

PROFILE_ORDER = ("gpu", "laptop")
"""Within a data set, where a figure is looked for first. Smoke runs decide nothing."""

_MARKS = dict(zip(judging.VERDICTS, "✓±>✗≈○", strict=False)) | {judging.REMARK: "·"}

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
    row = {"model": value.pop("model"), "window_frames": value.pop("window"), "steps": value.pop("steps")}
    return row | value


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


@functools.cache
def load_commands(paper: str = "f3amd") -> dict[str, list[str]]:
    """Return what one types to measure each claim again: id -> command lines, in the order of `commands.toml`."""
    commands = load_paper_file("commands", paper)["command"]
    return {name: [one["run"] for one in commands if name in one["claims"]] for name in load_claims(paper)}


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
    measured = [f"{_MARKS[s.verdict]} {s.figure}" for s in statements if s.verdict and s.verdict != judging.UNMEASURED]
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


def _by_group(judgements: Sequence[Judgement]) -> dict[str, list[Judgement]]:
    groups: dict[str, list[Judgement]] = {}
    for each in judgements:
        groups.setdefault(each.claim.group, []).append(each)
    return groups


def _short(statement: Statement | None) -> str:
    """Return what was found of a statement, behind its mark; metrics that miss and models stay in `statement_table`."""
    if statement is None or statement.verdict == judging.UNMEASURED:
        return ""
    figure = re.sub(r"; not: [^;]*| over \d+ models \(.*?\)| in the range", "", statement.figure)
    return f"{_MARKS[statement.verdict]} {figure}"


def _side(verdict: str, statements: Sequence[Statement], where: str = "") -> str:
    """Return one side's verdict on a claim behind its mark, where it holds, and the first reason why it is none."""
    mark, why = _MARKS.get(verdict, ""), next((f": {reason}" for one in statements for reason in one.reasons), "")
    return f"**{f'{mark} {verdict}'.strip()}**{where}{why}"


def claims_table(judgements: Sequence[Judgement]) -> str:
    """Return claims as Markdown: two columns of verdicts, and below each claim its statements with their figures."""
    rows = []
    for each in judgements:
        claim, on = each.claim, [name for name in (each.dataset, *each.times_of) if name in DATASET_ORDER[1:]]
        where = f" ({', '.join(on)})" if on else ""
        sides = (_side(each.verdict, each.ours, where), _side(each.paper_verdict, each.paper))
        rows.append((f"**{claim.id}** {claim.text} ({claim.where})", *sides))
        ours, paper = ({one.says: one for one in some} for some in (each.ours, each.paper))
        found = ((one.says, _short(ours.get(one.says)), _short(paper.get(one.says))) for one in claim.statements)
        rows += [row for row, one in zip(found, claim.statements, strict=True) if any(row[1:]) and not one.remark]
    return compact_table(pd.DataFrame(rows, columns=["claim", "ours", "the paper's tables"]))


def marks_picture(judgements: Sequence[Judgement]) -> str:
    """Return all verdicts as an SVG: a panel a group, a line a claim, a mark by our records and one by the paper's."""
    colors = read_toml(Path(__file__).with_name("claims_page.toml"))["colors"]
    groups = _by_group(judgements)
    width, height = 190 * len(groups), 50 + 22 * max(map(len, groups.values()))
    write = lambda x, y, text, how="": f'<text x="{x}" y="{y}" {how}>{html.escape(text)}</text>'
    drawn = [f'<rect width="{width}" height="{height}" fill="white"/>']
    for panel, (group, some) in enumerate(groups.items()):
        x = 10 + 190 * panel
        drawn.append(write(x, 18, group, 'font-weight="bold"'))
        drawn += [write(x + 40, 38, "ours"), write(x + 95, 38, "paper's")]
        for row, each in enumerate(some):
            drawn.append(write(x, 60 + 22 * row, each.claim.id))
            for place, verdict in ((x + 40, each.verdict), (x + 95, each.paper_verdict)):
                box = f'x="{place}" y="{45 + 22 * row}" width="40" height="20" fill="{colors[verdict]}"'
                mark = write(place + 20, 60 + 22 * row, _MARKS.get(verdict, ""), 'text-anchor="middle"')
                drawn.append(f"<rect {box}><title>{each.claim.id}: {verdict}</title></rect>{mark}")
    shape = f'viewBox="0 0 {width} {height}" width="{width}" height="{height}"'
    style = 'font-family="sans-serif" font-size="13"'
    return "\n".join([f'<svg xmlns="http://www.w3.org/2000/svg" {shape} {style}>', *drawn, "</svg>", ""])


def ledger_markdown(judgements: Sequence[Judgement]) -> str:
    """Render the ledger of one paper as Markdown: picture, counts, a table a group, records and commands, rules last.

    Args:
      judgements: from `judge_claims`, at least one.
    """
    paper = judgements[0].claim.paper
    texts = read_toml(Path(__file__).with_name("claims_page.toml"))
    about, words = load_paper_file("paper", paper), texts["page"] | load_paper_file("claims", paper).get("page", {})
    training = {"windows": {}, "says": "their number is not known"} | about.get("training", {})
    gpu = load_profile("gpu", "100style")
    seen = gpu.train_steps * gpu.batch_size
    share = 100.0 * seen / training["windows"].get("32", np.nan)
    fields = {"steps": gpu.train_steps, "batch": gpu.batch_size, "seen": seen / 1e6, "share": share}
    fields |= {"windows": training["says"], "here": scale(judgements)}
    fields |= {key: text.strip().format(**fields) for key, text in words.items()}
    fields |= {"count": len(load_claims(paper)), "name": about["name"], "setting": about["setting"], "paper": paper}
    fields |= {"marks": ", ".join(f"{mark} {verdict}" for verdict, mark in _MARKS.items() if verdict)}
    fields |= {"picture": ledger_path(paper).with_suffix(".svg").name}
    verdicts = {"ours": [one.verdict for one in judgements]}
    verdicts["the paper's tables"] = [one.paper_verdict for one in judgements]
    counts = pd.DataFrame({side: pd.Series(some).value_counts() for side, some in verdicts.items()})
    counts = counts.reindex(judging.VERDICTS).fillna(0).astype(int).rename_axis("verdict").reset_index()
    records: dict[tuple[str, str], list[str]] = {}
    for each in judgements:
        places = [(one.place, one.hardware) for found in each.ours if each.dataset for one in found.sources]
        for place in dict.fromkeys(places):
            records.setdefault(place, []).append(each.claim.id)
    looked = [{"record": place, "device": device, "claims": ", ".join(ids)} for (place, device), ids in records.items()]
    typed = [f"# {', '.join(one['claims'])}\n{one['run']}" for one in load_paper_file("commands", paper)["command"]]
    return "\n".join([
        texts["head"].format(**fields),
        markdown_table(counts),
        *(f"## {group}\n\n{claims_table(some)}" for group, some in _by_group(judgements).items()),
        f"## Records and commands\n\n{compact_table(pd.DataFrame(looked))}",
        "```sh", *typed, "```",
        texts["tail"].format(**fields),
    ])  # fmt: skip


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


def _verdicts(frame: pd.DataFrame) -> dict[str, dict[str, str]]:
    """Return what is accepted of a ledger, in the form of `accepted_verdicts`."""
    columns = ["verdict", "ours", "paper_verdict", "paper_figure"]
    return frame.set_index("id")[columns].rename(columns={"ours": "figure"}).to_dict("index")


def changed_verdicts(frame: pd.DataFrame, accepted: Mapping[str, Mapping[str, str]]) -> list[str]:
    """List the verdicts that are not the accepted ones, one sentence each.

    Args:
      frame: from `ledger`.
      accepted: from `accepted_verdicts`.
    """
    verdicts, sides = _verdicts(frame), {"our records": "", "the paper's tables": "paper_"}
    changes = [
        f"{name} by {whose}: was {was!r}, is {now[f'{side}verdict']!r} ({now[f'{side}figure']})"
        for name, now in verdicts.items()
        for whose, side in sides.items()
        if (was := accepted.get(name, {}).get(f"{side}verdict", "not accepted yet")) != now[f"{side}verdict"]
    ]
    return changes + [f"{name}: is no claim any more" for name in accepted if name not in verdicts]


def write_ledger(path: Path, judgements: Sequence[Judgement], *, accept: bool = False) -> list[str]:
    """Write the ledger as Markdown, and with `accept` its verdicts.

    Args:
      path: where to, ending in .md. The accepted verdicts lie beside it as JSON.
      judgements: from `judge_claims`.
      accept: accept changed verdicts and write them.

    Returns:
      What changed, as from `changed_verdicts`. Without `accept` a change leaves both files alone.
    """
    frame = ledger(judgements)
    changes = changed_verdicts(frame, accepted_verdicts(path))
    if accept or not changes:
        write_whole(path, ledger_markdown(judgements))
        write_whole(path.with_suffix(".svg"), marks_picture(judgements))
        kept = json.dumps(_verdicts(frame), indent=2, ensure_ascii=False)
        write_whole(path.with_suffix(".json"), f"{kept}\n")
    return changes


def main(accept: bool = False, paper: str | None = None) -> int:
    """Judge the papers' claims from records; writes paper_figures/claims.md and claims_<paper>.md.

    Args:
      accept: accept changed verdicts and write them.
      paper: whose claims; each paper's if none.

    Returns:
      Exit status: 0 if the ledgers were written, 1 if a verdict changed and was not accepted.

    Raises:
      ValueError: outside a clone of the repository, where the records lie.
    """
    status, folder = 0, ledger_path().parent
    if not folder.is_dir():
        raise ValueError(f"{folder}: has no records; run this in a clone of the repository")
    for name in [paper] if paper else [name for name in paper_folders() if has_paper_file("claims", name)]:
        path = ledger_path(name)
        changes = write_ledger(path, judge_claims(paper=name), accept=accept)
        for change in changes:
            log.info("%s", change)
        if changes and not accept:
            log.error("Nothing was written. If these verdicts are right: --accept")
            status = 1
        else:
            log.info("%s is up to date", path.relative_to(repository_root()))
    return status
