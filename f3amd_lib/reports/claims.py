"""The claims ledger: what the paper says, judged from records: `python -m f3amd_lib.reports.claims`.

Every claim is a value: its sentence in our words, its place in the paper, what decides it, and the
rule as code (`reports.ledger`). A verdict follows from recorded figures alone, and from none of ours
to none of the paper's: models of our own (`-plus`, `-raw`, ...) decide nothing. The same rule is
applied to the paper's own tables, which do not always say what its text says.

The verdicts are committed. When a new measurement changes one, a test fails until somebody has
looked at it and accepts the change on purpose (`--accept`).
"""

from __future__ import annotations

import argparse
import json
import logging
import re
import sys
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path

import pandas as pd

from f3amd_lib.ground.files import whole_file
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.papers import PAPER_SETTING
from f3amd_lib.ground.profiles import repository_root
from f3amd_lib.ground.tables import markdown_table
from f3amd_lib.reports.ledger import efficiency, quality, theory
from f3amd_lib.reports.ledger.evidence import Evidence, paper_evidence, recorded_evidence
from f3amd_lib.reports.ledger.verdicts import (
    FAILS,
    HOLDS,
    IN_PART,
    OPEN,
    REMARK,
    UNMEASURED,
    VERDICTS,
    Statement,
    combine,
)

log = logging.getLogger("f3amd")

DATASET_ORDER = ("bandai", "synthetic")
"""Whose records decide: real motion first. All statements of a claim come from one data set."""

PROFILE_ORDER = ("gpu", "laptop")
"""Within a data set, where a figure is looked for first. Smoke runs decide nothing."""

GROUPS = {"E": "Efficiency", "Q": "Motion quality", "T": "Theory"}
"""First letter of a claim's id -> what the claim is about."""

_RULES = efficiency.RULES | quality.RULES | theory.RULES
_MARKS = {HOLDS: "✓", IN_PART: "±", FAILS: "✗", OPEN: "≈", REMARK: "·"}
_SYNTHETIC = "synthetic (procedural, no real motion)"


@dataclass(frozen=True)
class Claim:
    """A claim of the paper.

    Attributes:
      id: E for efficiency, Q for motion quality, T for theory, and a number.
      text: what is claimed, in our words.
      where: sections and tables of the paper.
      decided_by: the quantity that decides it. SYN is the time of a round, ms.
      paper_says: the paper's figure, if it names one.
    """

    id: str
    text: str
    where: str
    decided_by: str
    paper_says: str = ""

    @property
    def group(self) -> str:
        """What the claim is about."""
        return GROUPS[self.id[0]]

    @property
    def rule(self) -> Callable[[Evidence], Iterator[Statement]]:
        """The rule that judges it, from evidence to statements."""
        return _RULES[self.id]

    @property
    def computed(self) -> bool:
        """Whether the library decides it by computing, without records."""
        return self.id in theory.COMPUTED


CLAIMS = (
    Claim(
        "E1",
        "F3AMD-FNO is 4 to 8 times as fast as CAMDM on a GPU as characters grow",
        "5.1, Table 1",
        "SYN CAMDM / SYN FNO-D at 16 to 1,024 characters; 32 frames, 8 steps",
        "4 to 8x",
    ),
    Claim(
        "E2",
        "F3AMD-Transformer is roughly 2.5 to 3.5 times as fast as CAMDM on a GPU",
        "5.1, Table 1",
        "SYN CAMDM / SYN Transformer-D; 32 frames, 8 steps",
        "2.5 to 3.5x",
    ),
    Claim(
        "E3",
        "With 64 frames FNO is 3 to 5 and Transformer 2 to 3 times as fast, with many characters",
        "5.1, Table 1",
        "SYN CAMDM / SYN F3AMD on a GPU; 64 frames, 8 steps",
        "3 to 5x; 2 to 3x",
    ),
    Claim(
        "E4",
        "On a CPU FNO is 5 to 8 times as fast at 4 to 8 characters and 3 to 4 times at 16 to 32, "
        "Transformer 2 to 3 times",
        "5.1, Table 1",
        "SYN CAMDM / SYN F3AMD on a CPU; 32 frames, 8 steps",
        "5 to 8x; 3 to 4x; 2 to 3x",
    ),
    Claim(
        "E5",
        "For crowds FNO-96 is 10 to 22 % faster than Transformer-64, on GPU and CPU",
        "5.2",
        "1 - SYN FNO-96 / SYN Transformer-64",
        "10 to 22 %",
    ),
    Claim(
        "E6",
        "An epoch of FNO takes about 5 min where CAMDM takes 12.5, and 6 against 20.6 with 64 frames",
        "5.1, Table 2",
        "ratio of training times at equal batch and data, GPU",
        "2.5x; 3.4x",
    ),
    Claim(
        "E7",
        "1 step in place of 8 makes FNO-96 6.4 times as fast on a CPU with 1 character and 3.4 "
        "times with 32, on a GPU 2.9 times with 1 and 6.5 times with 1,024",
        "5.3, Table 4",
        "SYN 8 steps / SYN 1 step",
        "6.4x; 3.4x; 2.9x; 6.5x",
    ),
    Claim(
        "E8",
        "FNO-96 with 1 step is about 4 times as fast as CAMDM with 8 at 16 characters, 25 times "
        "at 1,024 (GPU), and 10 to 20 times on a CPU",
        "5.3, Figure 4",
        "SYN CAMDM, 8 steps / SYN FNO-96, 1 step",
        "4x; 25x; 10 to 20x",
    ),
    Claim(
        "E9",
        "Keeping 4 of 17 modes saves 3 to 4 % of the time with few characters, about 8 % with "
        "some, 15 to 16 % with many",
        "App. E",
        "1 - SYN m = 4 / SYN m = 17",
        "3 to 4 %; 8 %; 15 to 16 %",
    ),
    Claim(
        "E10",
        "At 1,024 characters FiLM is 2 times as fast as concatenation, 32 % faster than "
        "cross-attention, 9 % faster than AdaLN-zero",
        "App. E, Table 11",
        "SYN variant / SYN FiLM, GPU",
        "2x; 1.32x; 1.09x",
    ),
    Claim(
        "E11",
        "CAMDM takes the same time in JAX and in PyTorch on a GPU; on a CPU PyTorch is 2 to 5 times as fast",
        "App. D, Table 7",
        "SYN JAX / SYN PyTorch",
        "alike; 2 to 5x",
    ),
    Claim(
        "E12",
        "FNO-96 with 1 step is over 20 times as fast as the JAX CAMDM with 8, on GPU and CPU: "
        "about 4 times by the architecture, about 5 times by the steps",
        "1, 5",
        "the ratio and its two factors in a large crowd",
        "20x = 4x · 5x",
    ),
    Claim(
        "E13",
        "F3AMD-FNO converges in as many epochs as CAMDM, or fewer",
        "5.1",
        "held-out loss and metrics against epochs",
    ),
    Claim(
        "E14",
        "Under ten characters FNO and Transformer have similar latency",
        "5.1",
        "SYN Transformer-D / SYN FNO-D at 1 to 8 characters, GPU",
        "similar",
    ),
    Claim(
        "E15",
        "Latency falls almost linearly with the number of steps, closer to linear with more characters",
        "6",
        "exponent of SYN against steps, fitted per number of characters (FNO-96)",
        "almost linear",
    ),
    Claim(
        "E16",
        "Low latent dimensions make training and inference 2 to 3 times as fast, and take less memory",
        "6",
        "SYN, training time and peak memory of FNO-128 over FNO-32",
        "2 to 3x",
    ),
    Claim(
        "E17",
        "Far fewer modes than T / 2 save a further 10 to 15 % with many characters",
        "6",
        "1 - SYN m = 4 / SYN m = 17, as in E9 (whose figure differs)",
        "10 to 15 %",
    ),
    Claim(
        "Q1",
        "EMD is similar for all models with 32 frames",
        "5.2, Table 3",
        "largest over least EMD of the models",
        "spread about 5 %",
    ),
    Claim(
        "Q2",
        "FNO has the better IRD, Transformer the better FID and style coverage",
        "5.2, Table 3",
        "sign of the differences, per latent dimension",
    ),
    Claim(
        "Q3",
        "CAMDM has the best FID, but a worse IRD than FNO-96",
        "5.2, Table 3",
        "sign of the differences",
        "0.143; 3.834 against 1.795 cm",
    ),
    Claim(
        "Q4",
        "With 64 frames F3AMD degrades a little and CAMDM fails",
        "5.2, Table 3",
        "metrics with 64 frames against 32",
        "minor; not reported",
    ),
    Claim(
        "Q5",
        "FNO-96 stays close in every metric at 8, 4, 2 and 1 steps",
        "5.3, Table 5",
        "relative change over the steps, with its interval",
        "close",
    ),
    Claim(
        "Q6",
        "CAMDM needs 4 steps: 2 degrade it and 1 breaks it",
        "6, Table 5",
        "the same metrics at 8, 4, 2 and 1 steps",
    ),
    Claim(
        "Q7",
        "CAMDM trained with VE and sampled with DDIM works in one step, about 5 times as fast as with 8",
        "6",
        "metrics and SYN of CAMDM-VE with 1 step against CAMDM with 8",
        "5x",
    ),
    Claim(
        "Q8",
        "A linear encoder and decoder lose style coverage and diversity",
        "App. E, Table 9",
        "those two metrics of FNO-96",
        "94.0 -> 87.4 %; 29.7 -> 16.1 cm",
    ),
    Claim("Q9", "m = 1 is poor; all larger m are alike", "App. E, Table 10", "metrics over m"),
    Claim(
        "Q10",
        "Cosine transform, weighted and reduced-rank FNO are alike overall",
        "App. E, Table 8",
        "metrics of the variants of FNO-96",
        "alike",
    ),
    Claim(
        "Q11",
        "FiLM, concatenation, AdaLN-zero and cross-attention are alike in quality",
        "App. E, Table 11",
        "metrics of the variants of FNO-96",
        "alike",
    ),
    Claim(
        "Q12",
        "CAMDM collapses at latent dimension 96",
        "6, Table 12",
        "style coverage and EMD of CAMDM-96 against FNO-96",
        "coverage 2 %; EMD doubles",
    ),
    Claim(
        "Q13",
        "The IRD loss lowers the discontinuity between windows",
        "4.1",
        "IRD of FNO-96 trained with and without the term",
    ),
    Claim(
        "Q14",
        "One-step sampling keeps diversity through noise, though it may lower it",
        "6",
        "diversity over seeds under one fixed condition, at 1 and 8 steps",
    ),
    Claim("Q15", "FNO may lose fine motion of the feet", "6", "spectrum of the feet against real motion, per model"),
    Claim("Q16", "Long rollouts drift", "6", "metrics against the number of the round"),
    Claim(
        "Q17",
        "CAMDM in JAX has lower trajectory and direction errors than in PyTorch, which is smoother with a higher IRD",
        "App. D, Table 6",
        "those four metrics, with the weights that CAMDM's authors published",
        "0.039 against 0.178 m",
    ),
    Claim(
        "Q18",
        "EMD agrees with perceived quality better than FID",
        "4.4",
        "order of graded corruptions by both (perception itself is not measured)",
    ),
    Claim("T1", "A VE state becomes a VP state by alpha_bar = 1 / (1 + sigma²)", "App. F", "identity, to rounding"),
    Claim(
        "T2",
        "The DDIM update with that alpha_bar is a valid deterministic sampler for a network trained with VE",
        "App. F",
        "equality with the Euler step in sigma, and where samples of an exact denoiser end",
    ),
    Claim(
        "T3", "Attention costs O(T D² + T² D), an FNO O(T log T D + m D²)", "6", "operations counted over T, D and m"
    ),
    Claim(
        "T4",
        "Training with VE gives consistent denoising over noise levels, so that DDIM can take one step",
        "2.1, 6",
        "x0 error against sigma, VE and VP models",
    ),
    Claim("T5", "A loss that is not scaled biases training towards high noise", "6", "gradient norm against sigma"),
)
"""The 40 claims, in the paper's order within each group."""


def find_claim(claim_id: str) -> Claim:
    """Return a claim by its id.

    Raises:
      ValueError: for an unknown id, with the nearest one.
    """
    by_id = {claim.id: claim for claim in CLAIMS}
    if claim_id not in by_id:
        raise ValueError(f"unknown claim {claim_id!r}{nearest_hint(claim_id, by_id)}")
    return by_id[claim_id]


# ------------------------------------------------------------------------------------------ judging


@dataclass(frozen=True)
class Judgement:
    """A claim with what our records and the paper's own tables say of it.

    Attributes:
      claim: what is judged.
      ours: statements from our records (or computed).
      paper: the same statements from the paper's tables; none for a computed claim.
      dataset: whose records decided; "" if none did.
    """

    claim: Claim
    ours: tuple[Statement, ...]
    paper: tuple[Statement, ...]
    dataset: str

    @property
    def verdict(self) -> str:
        """The verdict of our records."""
        return combine(statement.verdict for statement in self.ours)

    @property
    def paper_verdict(self) -> str:
        """The verdict of the paper's own tables."""
        return combine(statement.verdict for statement in self.paper)


def _seen(statements: Iterable[Statement]) -> tuple[Statement, ...]:
    """Leave out what was not measured and need not be."""
    return tuple(s for s in statements if not (s.optional and s.verdict == UNMEASURED))


def _merged(rule: Callable, evidences: Sequence[Evidence]) -> tuple[Statement, ...]:
    """Take each statement from the first evidence that can decide it."""
    merged: dict[str, Statement] = {}
    for evidence in evidences:
        for statement in rule(evidence):
            known = merged.get(statement.says)
            if known is None or (
                known.verdict == UNMEASURED and (statement.verdict != UNMEASURED or known.no_table > statement.no_table)
            ):
                merged[statement.says] = statement
    return _seen(merged.values())


def judge_claim(claim: Claim, evidences: Mapping[str, Sequence[Evidence]]) -> Judgement:
    """Judge a claim.

    Args:
      claim: which.
      evidences: data set -> its evidence; the first that can decide anything decides. At least one.

    Returns:
      The judgement; where nothing was measured, with the reasons of the first data set that has
      at least the table.
    """
    if claim.computed:
        return Judgement(claim, _seen(claim.rule(paper_evidence())), (), "computed")
    paper = _seen(claim.rule(paper_evidence()))
    tried = []
    for dataset, some in evidences.items():
        ours = _merged(claim.rule, some)
        if combine(statement.verdict for statement in ours) != UNMEASURED:
            return Judgement(claim, ours, paper, dataset)
        tried.append(ours)
    # A row that is missing says more than a missing table.
    says_more = (ours for ours in tried if not all(statement.no_table for statement in ours))
    return Judgement(claim, next(says_more, tried[0]), paper, "")


def _names(given) -> tuple[str, ...]:
    return (given,) if isinstance(given, str) else tuple(given)


def judge_claims(root=None, dataset=DATASET_ORDER, profile=PROFILE_ORDER) -> list[Judgement]:
    """Judge all claims from recorded results.

    Args:
      root: folder of results; `paper_figures/` of the checkout by default.
      dataset: whose records decide, or several of which the first that can does.
      profile: of `profiles.PROFILES`, or several, without "smoke".

    Returns:
      One judgement a claim, in the order of `CLAIMS`.

    Raises:
      ValueError: for unknown names, or records that are broken or lie in the wrong folder.
    """
    root = repository_root() / "paper_figures" if root is None else Path(root)
    evidences = {data: [recorded_evidence(root, data, name) for name in _names(profile)] for data in _names(dataset)}
    return [judge_claim(claim, evidences) for claim in CLAIMS]


# ------------------------------------------------------------------------------------------ writing


def _figures(statements: Iterable[Statement]) -> str:
    """Return all figures in one line, each with a mark for its verdict; or why there are none."""
    statements = list(statements)
    measured = [s for s in statements if s.verdict not in (UNMEASURED, REMARK)]
    if not measured:
        reasons = dict.fromkeys(s.figure for s in statements if s.verdict == UNMEASURED)
        first, more = next(iter(reasons), ""), len(reasons) - 1
        return first + (f"; and {more} more" if more > 0 else "")
    told = "; ".join(f"{_MARKS[s.verdict]} {s.figure}" for s in measured)
    gaps = sum(s.verdict == UNMEASURED for s in statements)
    return told + (f"; {gaps} of {gaps + len(measured)} not measured" if gaps else "")


def _sources(judgement: Judgement, part: str) -> str:
    if not judgement.dataset:  # a remark may have looked into a table, and decided nothing
        return ""
    sources = (source for statement in judgement.ours for source in statement.sources)
    return "; ".join(dict.fromkeys(getattr(s, part) if part else str(s) for s in sources))


def _row(judgement: Judgement) -> dict:
    claim = judgement.claim
    return {
        "id": claim.id,
        "group": claim.group,
        "claim": claim.text,
        "where": claim.where,
        "decided_by": claim.decided_by,
        "verdict": judgement.verdict,
        "ours": _figures(judgement.ours),
        "paper_says": claim.paper_says,
        "paper_verdict": judgement.paper_verdict,
        "paper_figure": _figures(judgement.paper),
        "dataset": _SYNTHETIC if judgement.dataset == "synthetic" else judgement.dataset,
        "hardware": "float64" if claim.computed else _sources(judgement, "hardware"),
        "record": _sources(judgement, ""),
    }


def ledger(
    root=None, dataset=DATASET_ORDER, profile=PROFILE_ORDER, *, judgements: Sequence[Judgement] | None = None
) -> pd.DataFrame:
    """Return the claims ledger as a table.

    Args:
      root, dataset, profile: as for `judge_claims`.
      judgements: from there, to save judging again.

    Returns:
      One row a claim: id, group, claim, where, decided_by, verdict, ours (figures with their
      intervals, or why there are none), paper_says, paper_verdict and paper_figure (the same rule
      on the paper's own tables), dataset, hardware, record (file and the first digits of its
      SHA-256).

    Raises:
      ValueError: as `judge_claims`.
    """
    judgements = judge_claims(root, dataset, profile) if judgements is None else judgements
    return pd.DataFrame([_row(judgement) for judgement in judgements])


def statement_table(judgement: Judgement) -> pd.DataFrame:
    """Return the statements behind a judgement: statement, ours, the paper's tables."""

    def told(statement: Statement | None) -> str:
        if statement is None:
            return ""
        if statement.verdict == UNMEASURED:
            return f"{UNMEASURED} ({statement.figure})"
        return statement.figure + (f" · {statement.verdict}" if statement.verdict else "")

    ours, paper = ({s.says: s for s in some} for some in (judgement.ours, judgement.paper))
    rows = []
    longer, shorter = (ours, paper) if len(ours) >= len(paper) else (paper, ours)
    for says in dict.fromkeys([*longer, *shorter]):
        known = [some[says] for some in (ours, paper) if says in some]
        remark = any(statement.verdict == REMARK for statement in known)
        rows.append(
            {
                "statement": f"({says})" if remark else says,
                "ours": told(ours.get(says)),
                "the paper's tables": told(paper.get(says)),
            }
        )
    return pd.DataFrame(rows)


_HEAD = f"""# Claims ledger

40 claims of the F3AMD paper, each judged by a rule in code (`f3amd_lib/reports/ledger/`) that was
written before our numbers were known. This page is generated by
`python -m f3amd_lib.reports.claims` from committed records; nothing in it was typed.

- **ours**: from our records; real motion (`bandai`) decides, else `synthetic`, which is labelled.
  Times on a GPU decide claims about a GPU, times on a CPU those about a CPU. Networks of a record
  under `laptop` were trained for minutes on two cores, those under `gpu` at the paper's length.
- **the paper's tables**: the same rule on the paper's own figures, which have no intervals:
  {PAPER_SETTING}.
- A claim **holds in part** where only some of its statements do, or only some were measured, or
  where a gain is larger than stated. A difference that lies inside its interval **cannot be told
  apart**.
- Marks: {", ".join(f"{mark} {verdict}" for verdict, mark in _MARKS.items() if verdict)}.
  Statements in brackets are remarks, which decide nothing.
"""


def _compact(table: str) -> str:
    """Take the padding out of a Markdown table, so that a changed cell is a changed line."""
    lines = [re.sub(r" {2,}", " ", line) for line in table.splitlines()]
    lines[1] = re.sub("-{4,}", "---", lines[1])
    return "\n".join(lines) + "\n"


def ledger_markdown(judgements: Sequence[Judgement] | None = None) -> str:
    """Render the ledger as Markdown: counts, a table for each group, then every statement.

    Args:
      judgements: from `judge_claims`; judged from the committed records by default.
    """
    judgements = judge_claims() if judgements is None else judgements
    frame = ledger(judgements=judgements)
    counts = pd.DataFrame(
        {
            "verdict": verdict,
            "ours": int((frame["verdict"] == verdict).sum()),
            "the paper's tables": int((frame["paper_verdict"] == verdict).sum()),
        }
        for verdict in VERDICTS
    )
    parts = [_HEAD, markdown_table(counts)]
    for group in GROUPS.values():
        rows = frame[frame["group"] == group]
        short = pd.DataFrame(
            {
                "": rows["id"],
                "claim": rows["claim"],
                "where": rows["where"],
                "ours": rows["verdict"] + ": " + rows["ours"],
                "paper says": rows["paper_says"],
                "the paper's tables": [
                    "no figures" if verdict == UNMEASURED else f"{verdict}: {figure}"
                    for verdict, figure in zip(rows["paper_verdict"], rows["paper_figure"], strict=True)
                ],
                "data set": rows["dataset"],
                "hardware": rows["hardware"],
                "record": rows["record"],
            }
        )
        parts.append(f"## {group}\n\n{_compact(markdown_table(short))}")
    parts.append("## Statement by statement\n")
    for judgement in judgements:
        claim = judgement.claim
        parts.append(
            f"### {claim.id} · {claim.text}\n\nPaper {claim.where}. Decided by {claim.decided_by}."
            f"\n\n{_compact(markdown_table(statement_table(judgement)))}"
        )
    return "\n".join(parts)


def _verdict_file(path: Path) -> Path:
    return path.with_suffix(".json")


def accepted_verdicts(path=None) -> dict[str, dict[str, str]]:
    """Read the verdicts that were accepted.

    Args:
      path: of the ledger (`.md`) beside which they lie; `paper_figures/claims.md` by default.

    Returns:
      Claim id -> verdict, figure, paper_verdict, paper_figure; empty if nothing was accepted yet.
    """
    path = _verdict_file(repository_root() / "paper_figures" / "claims.md" if path is None else path)
    return json.loads(path.read_text(encoding="utf-8")) if path.exists() else {}


def changed_verdicts(frame: pd.DataFrame, accepted: Mapping[str, Mapping[str, str]]) -> list[str]:
    """List the verdicts that are not the accepted ones, one sentence each.

    Args:
      frame: from `ledger`.
      accepted: from `accepted_verdicts`.
    """
    changes = []
    for row in frame.to_dict("records"):
        before = accepted.get(row["id"], {})
        for key, whose, figure in (
            ("verdict", "our records", "ours"),
            ("paper_verdict", "the paper's tables", "paper_figure"),
        ):
            if before.get(key) != row[key]:
                was = f"{before[key]!r}" if key in before else "not accepted yet"
                changes.append(f"{row['id']} by {whose}: was {was}, is {row[key]!r} ({row[figure]})")
    known = set(frame["id"])
    return changes + [f"{name}: is no claim any more" for name in accepted if name not in known]


def write_ledger(path=None, judgements: Sequence[Judgement] | None = None, *, accept: bool = False) -> list[str]:
    """Write the ledger as Markdown, and accept its verdicts if asked to.

    Args:
      path: where to, ending in .md; `paper_figures/claims.md` by default. The accepted verdicts lie
        beside it as JSON.
      judgements: from `judge_claims`; judged from the committed records by default.
      accept: take changed verdicts for right and write them down.

    Returns:
      What changed, as from `changed_verdicts`. Without `accept` a change leaves both files alone.

    Raises:
      ValueError: if the name does not end in .md.
    """
    path = repository_root() / "paper_figures" / "claims.md" if path is None else Path(path)
    if path.suffix != ".md":
        raise ValueError(f"{path}: the ledger's name must end in .md")
    judgements = judge_claims() if judgements is None else judgements
    frame = ledger(judgements=judgements)
    changes = changed_verdicts(frame, accepted_verdicts(path))
    if changes and not accept:
        return changes
    verdicts = {
        row["id"]: {
            "verdict": row["verdict"],
            "figure": row["ours"],
            "paper_verdict": row["paper_verdict"],
            "paper_figure": row["paper_figure"],
        }
        for row in frame.to_dict("records")
    }
    texts = {
        path: ledger_markdown(judgements),
        _verdict_file(path): json.dumps(verdicts, indent=2, ensure_ascii=False) + "\n",
    }
    for place, text in texts.items():
        with whole_file(place, overwrite=True) as temporary:
            temporary.write_text(text, encoding="utf-8", newline="\n")
    return changes


def main(arguments: list[str] | None = None) -> int:
    """Run the command line; see the module's first lines.

    Args:
      arguments: words after the program's name; those of the process by default.

    Returns:
      Exit status: 0 if the ledger was written, 1 if a verdict changed and was not accepted, 2 for
      records that are broken.
    """
    parser = argparse.ArgumentParser(
        prog="python -m f3amd_lib.reports.claims",
        description="Judge the paper's claims from records; writes paper_figures/claims.md.",
    )
    parser.add_argument("--accept", action="store_true", help="take changed verdicts for right and write them down")
    options = parser.parse_args(arguments)
    logging.basicConfig(level=logging.INFO, format="%(message)s")
    try:
        changes = write_ledger(accept=options.accept)
    except ValueError as error:
        log.error("Stopped: %s", error)
        return 2
    for change in changes:
        log.info("%s", change)
    if changes and not options.accept:
        log.error("Nothing was written. If these are right: --accept")
        return 1
    log.info("paper_figures/claims.md is up to date")
    return 0


if __name__ == "__main__":
    sys.exit(main())
