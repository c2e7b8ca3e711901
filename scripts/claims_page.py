"""Write the pages of the claims ledger, `paper_figures/claims*.md` with picture and accepted verdicts (JSON).

    python scripts/claims_page.py [--paper NAME] [--accept]

A verdict that changed since it was accepted is listed, and nothing is written until `--accept` says that it is right.
"""

import argparse
import html
import json
import re
from collections.abc import Sequence
from pathlib import Path

import numpy as np
import pandas as pd

from f3amd_companion.ledger import judgements as judging
from f3amd_companion.ledger.claims import (
    DATASET_ORDER,
    MARKS,
    Judgement,
    Statement,
    accepted_verdicts,
    changed_verdicts,
    judge_claims,
    ledger,
    ledger_path,
    load_claims,
    scale,
    verdicts_of,
)
from f3amd_lib.ground.files import read_toml, write_whole
from f3amd_lib.ground.papers import has_paper_file, load_paper_file, paper_folders
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.tables import compact_table, markdown_table


def _by_group(judgements: Sequence[Judgement]) -> dict[str, list[Judgement]]:
    groups: dict[str, list[Judgement]] = {}
    for each in judgements:
        groups.setdefault(each.claim.group, []).append(each)
    return groups


def _short(statement: Statement | None) -> str:
    """Return what was found of a statement, behind its mark; metrics that miss and models stay in `statement_table`."""
    if statement is None or statement.verdict == judging.UNMEASURED:
        return ""
    figure = re.sub(r"; not shown: [^;]*| over \d+ models \(.*?\)| in the range", "", statement.figure)
    return f"{MARKS[statement.verdict]} {figure}"


def _side(verdict: str, statements: Sequence[Statement], where: str = "") -> str:
    """Return one side's verdict on a claim behind its mark, where it holds, and the first reason why it is none."""
    mark, why = MARKS.get(verdict, ""), next((f": {reason}" for one in statements for reason in one.reasons), "")
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
                mark = write(place + 20, 60 + 22 * row, MARKS.get(verdict, ""), 'text-anchor="middle"')
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
    fields |= {"marks": ", ".join(f"{mark} {verdict}" for verdict, mark in MARKS.items() if verdict)}
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
        kept = json.dumps(verdicts_of(frame), indent=2, ensure_ascii=False)
        write_whole(path.with_suffix(".json"), f"{kept}\n")
    return changes


def papers_with_claims() -> list[str]:
    """Return the folders of the papers that have a ledger."""
    return [name for name in paper_folders() if has_paper_file("claims", name)]


def main() -> int:
    """Write the pages that are asked for; return 1 if a verdict changed and was not accepted."""
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("--paper", choices=papers_with_claims(), help="whose claims; each paper's if none")
    parser.add_argument("--accept", action="store_true", help="accept changed verdicts and write them")
    asked, status = parser.parse_args(), 0
    for name in [asked.paper] if asked.paper else papers_with_claims():
        for change in write_ledger(ledger_path(name), judge_claims(paper=name), accept=asked.accept):
            print(change)
            status = int(not asked.accept)
    if status:
        print("Their pages were not written. If these verdicts are right: --accept")
    return status


if __name__ == "__main__":
    raise SystemExit(main())
