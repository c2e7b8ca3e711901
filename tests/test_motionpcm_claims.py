"""The ledger of the MotionPCM paper: every claim with an oracle and a nonsense, the gate, the paper's own tables."""

import functools

from test_acmdm_claims import judged as judged_of

from f3amd_companion.ledger import claims
from f3amd_companion.ledger.evidence import paper_evidence
from f3amd_companion.ledger.judgements import FAILS, HOLDS, OPEN, UNJUDGED, UNMEASURED, combine

PAPER, ENOUGH = "motionpcm", 300_000
METRICS = ("text_FID", "R_precision_1", "matching_distance")
TEACHER, STUDENT, LCM = "MotionPCM-teacher", "MotionPCM-M1", "MotionLCM-V2"

# How bad each is where all that the paper says is true; a metric for which high is good gets the inverse.
TABLE1 = {("MotionPCM-M1", 1): 1.5, ("MotionPCM-M2", 2): 1.2, ("MotionPCM-M4", 4): 1.0}
TABLE1 |= {(LCM, 1): 2.4, (LCM, 2): 1.8, (LCM, 4): 1.9}
TABLE1 |= {(name, 0): 3.0 for name in ("B2A-HDM", "StableMoFusion", "ReMoDiffuse", "T2M-GPT", "MLD")}
TABLE4 = {(TEACHER, 50): 2.0, (TEACHER, 10): 2.1, (TEACHER, 4): 4.0, (TEACHER, 2): 60.0, (TEACHER, 1): 300.0}
TABLE4 |= {(STUDENT, 1): 1.5}
TABLE2 = {"": 1.0, "-k50": 1.4, "-k20": 1.6, "-k1": 2.0, "-mu0": 1.3, "-mu0.5": 1.2, "-lambda0": 2.3, "-lambda1": 1.1}


def row(metric, badness, *, windows=ENOUGH, trained=None, **columns):
    value = 0.1 / badness if metric.startswith("R_") else 0.1 * badness
    about = {**columns, "trained": trained or columns["model"], "windows": windows, "metric": metric}
    return {**about, "value": value, "low": 0.99 * value, "high": 1.01 * value}


def world(true=True, **about):
    """Tables of a world in which the paper is right, or wrong in every claim."""
    turned = (lambda badness: badness) if true else (lambda badness: 10.0 / badness)
    one, two, four = [], [], []
    for (model, steps), badness in TABLE1.items():
        place = {"dataset": "HumanML3D", "model": model, "steps": steps}
        one += [row(metric, turned(badness), **place, **about) for metric in METRICS]
        seconds = (0.3 if true else 0.6 if model != LCM else 0.2) + 0.03 * steps
        one += [row("sampling_seconds", seconds, **place, **about)]
    for (model, steps), badness in TABLE4.items():
        badness = 2.0 * badness if not true and steps == 50 else badness
        four += [row(metric, turned(badness), model=model, steps=steps, **about) for metric in METRICS]
    for suffix, badness in TABLE2.items():
        for metric in METRICS:
            # A heavier discriminator has the better FID and the worse obedience.
            here = 0.8 if suffix == "-lambda1" and metric == "text_FID" else badness
            two.append(row(metric, turned(here), model=STUDENT + suffix, **about))
    return {"text_pcm1": one, "text_pcm2": two, "text_pcm4": four}


judged = functools.partial(judged_of, paper=PAPER)


def test_every_claim_holds_in_the_papers_world_and_fails_in_the_other(tmp_path):
    right, wrong = judged(tmp_path / "right", world()), judged(tmp_path / "wrong", world(true=False))
    assert len(right) == 13 and {claim: found.verdict for claim, found in right.items()} == dict.fromkeys(right, HOLDS)
    assert {claim: found.verdict for claim, found in wrong.items()} == dict.fromkeys(wrong, FAILS)


def test_one_training_and_missing_records_decide_nothing_and_small_networks_times_nothing_by_themselves(tmp_path):
    small = judged(tmp_path / "small", world(trained="MotionPCM-M1-small"))
    once = judged(tmp_path / "once", world(seed=0, length=1.0))
    nothing = judged(tmp_path / "nothing", {"text_pcm2": world()["text_pcm2"]})
    assert {claim for claim, found in small.items() if found.verdict != HOLDS} == {"S1"}
    assert {found.verdict for found in once.values()} == {UNJUDGED}
    for claim, found in nothing.items():
        assert found.verdict == (HOLDS if claim[0] == "D" else UNMEASURED), claim


def test_the_papers_own_tables_say_what_its_text_says_but_for_the_moving_average():
    verdicts = {}
    for claim in claims.load_claims(PAPER).values():
        statements = claim.judge(paper_evidence(PAPER))
        verdicts[claim.id] = combine(s.verdict for s in statements if not s.optional)
    assert verdicts == dict.fromkeys(verdicts, HOLDS) | {"D2": OPEN}
