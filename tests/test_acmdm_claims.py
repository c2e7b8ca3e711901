"""The ledger of the ACMDM paper: every rule with an oracle and a nonsense, the gate, the paper's own tables."""

import pandas as pd
import pytest

from f3amd_companion.ledger import claims
from f3amd_companion.ledger.evidence import paper_evidence, recorded_evidence
from f3amd_companion.ledger.judgements import FAILS, HOLDS, IN_PART, OPEN, REMARK, UNJUDGED, UNMEASURED, combine
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.records import write_table
from f3amd_lib.papers.printed import check_model

S = "ACMDM-S-PS22"
PAPER = "acmdm"
ENOUGH = 1e7
OTHERS = ("MARDM-v", "MARDM-eps", "MLD++", "MotionLCM V2", "ReMoDiffuse", "MotionDiffuse", "MDM-50Step")
JOINTS = ("pelvis", "left foot", "right foot", "head", "left wrist", "right wrist")


def rows(figures, metrics=None, *, trained=None, windows=ENOUGH, half=0.01, **shared):
    """Rows of a table of text to motion.

    `figures` is (model, columns) or model -> badness; where a high figure is good its inverse is told. `metrics` are
    names; both FID and R-precision by default.
    """
    table = []
    for key, badness in figures.items():
        model, columns = key if isinstance(key, tuple) else (key, ())
        for metric in metrics or ("text_FID", "R_precision_3"):
            value = 0.1 / badness if metric.startswith(("R_", "CLIP")) else 0.1 * badness
            found = {"model": model, "trained": trained or model, "windows": windows, **shared, **dict(columns)}
            table.append(
                {**found, "metric": metric, "value": value, "low": value * (1 - half), "high": value * (1 + half)}
            )
    return table


def order(*models):
    return dict(zip(models, range(1, len(models) + 1), strict=True))


def table1(*models):
    return {"text_table1": rows(order(*models))}


def all_of_table1(*suffixes):
    """All representations by objective, the suffixes in their order from good to bad."""
    bases = ("-redundant", "-raw-concatenation", "-raw", "")
    return {
        "text_table1": rows({S + base + suffix: place + 1 for base in bases for place, suffix in enumerate(suffixes)})
    }


def guidance(better, worse):
    sizes = [*(f"ACMDM-{size}-PS22" for size in ("S", "B", "L", "XL"))]
    return {
        "text_tableA1": rows({(size, (("cfg", cfg),)): bad for size in sizes for cfg, bad in ((better, 1), (worse, 2))})
    }


def scaling(*models):
    return {
        "text_tableA1": rows(
            {(model, (("cfg", cfg),)): place + 1 for place, model in enumerate(models) for cfg in ("yes", "no")}
        )
    }


def patches(*sizes):
    both = [[f"ACMDM-{size}-PS{patch}" for patch in sizes] for size in ("S", "XL")]
    return {"text_tableA1": scaling(*both[0])["text_tableA1"] + scaling(*both[1])["text_tableA1"]}


def methods(*models):
    metrics = ("text_FID", "R_precision_1", "matching_distance", "CLIP_score")
    return {"text_table2": rows(order(*models), metrics)}


def control(section, joint, figures, *metrics):
    return rows(figures, metrics, section=section, joint=joint)


def pelvis_and_all(ours, theirs, times):
    """Average errors and seconds of a sentence."""
    errors = {S: ours, "OmniControl": theirs, "MotionLCM V2+CtrlNet": 2 * theirs}
    error, seconds = "control_average_error", "sampling_seconds"
    return {
        "text_table3": [
            *control("trained on pelvis", "pelvis", errors, error),
            *control("trained on all joints", "average", errors, error),
            *control("trained on pelvis", "pelvis", {S: 1, "OmniControl": times}, seconds),
        ]
    }


def by_joint(ours, theirs):
    figures = {S: ours, "OmniControl": theirs}
    parts = [control("trained on all joints", joint, figures, "control_average_error") for joint in JOINTS]
    return {"text_table3": sum(parts, [])}


def noise_optimisation(seconds, missed):
    both = ("sampling_seconds", "control_average_error", "control_location_error")
    return {
        "text_table3": [
            *control("trained on all joints", "average", {S: 1}, *both),
            *control("noise optimisation", "average", {S: seconds}, "sampling_seconds", "control_average_error"),
            *control("noise optimisation", "average", {S: 10 * missed}, "control_location_error"),
        ]
    }


def edits(*models):
    return {"text_table3": rows(order(*models), section="upper-body edit", joint="")}


def autoregressive(generated, true_first=None):
    first = {"first_prefix": "generated"}
    forms = {f"ACMDM-S-PS2-{form}": badness for form, badness in generated.items()}
    table = rows(forms, **first)
    if true_first is not None:
        table += rows({"ACMDM-S-PS2-prefix": true_first}, first_prefix="ground truth")
    return {"text_tableA5": table}


CONCATENATED = [f"{S}-raw{form}{objective}" for form in ("", "-concatenation") for objective in ("", "-eps", "-x0")]
SIZES = [f"ACMDM-{size}-PS22" for size in ("XL", "L", "B", "S")]
AUTOENCODERS = (S, f"{S}-non-causal-AE", f"{S}-causal-VAE", f"{S}-non-causal-VAE")
EDITORS = ("OmniControl", "MotionLCM V2+CtrlNet", "MDM")
R3 = (f"{S}-redundant-x0", f"{S}-raw-concatenation-x0", f"{S}-raw-concatenation", f"{S}-redundant")

# Claim -> (tables for which it must hold, tables for which it must not).
CASES = {
    "R1": (table1(f"{S}-raw", f"{S}-raw-eps", f"{S}-raw-x0"), table1(f"{S}-raw-x0", f"{S}-raw-eps", f"{S}-raw")),
    "R2": (all_of_table1("", "-eps", "-x0"), all_of_table1("-x0", "-eps", "")),
    "R3": (table1(*R3), table1(*(R3[place] for place in (1, 0, 3, 2)))),
    "R4": (table1(R3[2], R3[0]), table1(R3[0], R3[2])),
    "R5": (table1(*CONCATENATED), table1(*CONCATENATED[3:], *CONCATENATED[:3])),
    "R6": (table1(S, f"{S}-raw"), table1(f"{S}-raw", S)),
    "R7": (table1(*AUTOENCODERS), table1(*AUTOENCODERS[1:], S)),
    "S1": (guidance("yes", "no"), guidance("no", "yes")),
    "S2": (scaling(*SIZES), scaling(*SIZES[::-1])),
    "S3": (patches(2, 11, 22), patches(22, 11, 2)),
    "S4": (methods("ACMDM-XL-PS2", S, *OTHERS), methods(*OTHERS, S, "ACMDM-XL-PS2")),
    "C1": (pelvis_and_all(1, 3, 32), pelvis_and_all(3, 1, 2)),
    "C2": (by_joint(1, 2), by_joint(2, 1)),
    "C3": (noise_optimisation(11, 0.0003), noise_optimisation(1, 0.3)),
    "C4": (edits(S, *EDITORS), edits(*EDITORS, S)),
    "A1": (
        autoregressive({"prefix": 1.05, "noisy-condition": 1.04, "masked": 1}),
        autoregressive({"prefix": 9, "noisy-condition": 9, "masked": 1}),
    ),
    "A2": (autoregressive({"prefix": 2}, 1), autoregressive({"prefix": 1}, 2)),
}  # fmt: skip


def judge(root, tables, claim_id):
    record = {"dataset": "bandai", "profile": "laptop", "seed": 0, "device_platform": "cpu", "cores": 2}
    for name, table in tables.items():
        write_table(root / "bandai" / "laptop" / "records" / f"{name}.csv", pd.DataFrame(table), record)
    evidence = [recorded_evidence(root, "bandai", "laptop")]
    return claims.judge_claim(claims.load_claims(PAPER)[claim_id], {"bandai": evidence})


def test_every_claim_has_an_oracle_and_a_nonsense():
    assert list(CASES) == list(claims.load_claims(PAPER)) == list(claims.load_commands(PAPER))


@pytest.mark.parametrize("wanted", [HOLDS, FAILS])
@pytest.mark.parametrize("claim_id", CASES)
def test_each_rule_passes_its_oracle_and_fails_its_nonsense(tmp_path, claim_id, wanted):
    judgement = judge(tmp_path, CASES[claim_id][wanted == FAILS], claim_id)
    assert judgement.verdict == wanted, judgement.ours
    assert all(s.sources for s in judgement.ours if s.verdict not in (UNMEASURED, REMARK))


@pytest.mark.parametrize("claim_id", [name for name, (tables, _) in CASES.items() if name not in ("S4", "C3")])
def test_each_rule_needs_intervals_that_lie_apart(tmp_path, claim_id):
    """With intervals as wide as the figures nothing is told apart."""
    wide = {
        name: [{**row, "low": 0.05 * row["value"], "high": 20 * row["value"]} for row in table]
        for name, table in CASES[claim_id][0].items()
    }
    assert judge(tmp_path, wide, claim_id).verdict == OPEN


@pytest.mark.parametrize(
    ("changes", "reason"),
    [
        ({"trained": f"{S}-raw-n3"}, "a smaller network of ours in its place"),
        ({"windows": 192_000}, "trained 1.6 % of the paper's motions"),
    ],
)
def test_small_or_brief_networks_decide_nothing(tmp_path, changes, reason):
    table = rows(order(f"{S}-raw", f"{S}-raw-eps", f"{S}-raw-x0"), **changes)
    judgement = judge(tmp_path, {"text_table1": table}, "R1")
    assert judgement.verdict == UNJUDGED
    assert all(reason in s.reasons and s.figure for s in judgement.ours)


def test_all_models_of_the_file_are_presets_or_named_as_others():
    others = load_paper_file("paper", PAPER)["others"]
    told = [row for claim in load_paper_file("claims", PAPER)["claim"] for statement in claim["statement"]
            for row in (*statement.get("rows", ()), statement.get("among", {}), statement.get("row", {}))]  # fmt: skip
    models = {row["model"] for row in told if "model" in row}
    assert len(models) > 30
    for model in models - set(others):
        check_model(model, "claims.toml")


# Claim -> verdict that the paper's own tables give, and a figure.
PAPERS_OWN = {
    "R1": (IN_PART, "0.121, 0.125, 0.133"),
    "R7": (OPEN, "0.109 against 0.15, 0.115, 0.178"),
    "S1": (HOLDS, "0.065, 0.194"),
    "S2": (IN_PART, "0.194, 0.181, 0.145, 0.178"),
    "S4": (IN_PART, "3.25 against 3.27, 3.35, 3.22, 3.19, 3.41, 3.49, 3.64"),
    "C1": (HOLDS, "32.3 times"),
    "C3": (HOLDS, "11.1 times"),
}


@pytest.mark.parametrize("claim_id", PAPERS_OWN)
def test_what_the_papers_own_tables_say(claim_id):
    statements = claims.load_claims(PAPER)[claim_id].judge(paper_evidence(PAPER))
    verdict, figure = PAPERS_OWN[claim_id]
    assert combine(s.verdict for s in statements if not s.optional) == verdict
    assert figure in [s.figure for s in statements]


def test_the_papers_intervals_and_captions_arrive():
    paper = paper_evidence(PAPER)
    found = paper.figure("text_table1", model=f"{S}-raw", metric="text_FID")
    assert (found.value, found.low, found.high) == pytest.approx((0.121, 0.115, 0.127))
    row = {"model": S, "joint": "average", "metric": "control_average_error"}
    assert paper.figure("text_table3", section="noise optimisation", **row).value == 0.0121
    assert paper.figure("text_table3", section="trained on all joints", **row).value == 0.0197


def test_the_committed_page_is_up_to_date():
    judgements = claims.judge_claims(paper=PAPER)
    assert not claims.changed_verdicts(claims.ledger(judgements), claims.accepted_verdicts(claims.ledger_path(PAPER)))
    assert claims.ledger_path(PAPER).read_text(encoding="utf-8") == claims.ledger_markdown(judgements), (
        "paper_figures/claims_acmdm.md is stale: run `f3amd claims`"
    )
