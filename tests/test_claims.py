"""The claims ledger: every rule on made-up records, accepted verdicts, whose records decide."""

import functools
from itertools import product
from types import SimpleNamespace

import claims_page
import numpy as np
import pandas as pd
import pytest
from builders import refused

from f3amd_companion.ledger import claims, theory
from f3amd_companion.ledger.evidence import (
    NINE_METRICS,
    OF_TEXT,
    OF_TRAINED_NETWORKS,
    REFERENCE_ROWS,
    Figure,
    mean_figure,
    paper_evidence,
    power_law,
    ratio,
    recorded_evidence,
    snapshot_evidence,
)
from f3amd_companion.ledger.gate import converged
from f3amd_companion.ledger.judgements import (
    FAILS,
    HOLDS,
    IN_PART,
    LARGER,
    OPEN,
    REMARK,
    TOLERANCE,
    UNJUDGED,
    UNMEASURED,
    VERDICTS,
    combine,
    equal_range,
    every,
    majority,
    ordered,
    ranked,
    stated_factor,
    within,
)
from f3amd_lib.ground.records import committed_table, write_table
from f3amd_lib.networks.attention import TransformerBlock
from f3amd_lib.networks.spectral import FNOBlock

# --------------------------------------------------------------------------------- made-up records

FNO, T64, CAMDM = "F3AMD-FNO-96", "F3AMD-Transformer-64", "CAMDM"
FNO_32, FNO_128, VE, PUBLISHED = "F3AMD-FNO-32", "F3AMD-FNO-128", "CAMDM-VE", "CAMDM published"
GPU_FEW, GPU_MANY = (1, 2, 4, 8, 16), (32, 64, 128, 256, 512, 1024)
FEW, SOME, MANY = (1, 2, 4, 8), (16, 32, 64, 128), (256, 512, 1024)
CPU_COUNTS = (1, 2, 4, 8, 16, 32)
WALKS = {"stepping_rate": 1.8, "joint_acceleration": 1.0, "slide_speed": 5.0, "floor_penetration": 0.2}
BASE = {
    "FID": 10.0, "EMD": 16.0, "style_coverage": 90.0, "trajectory_error": 0.03, "direction_error": 3.0,
    "smoothness": 2.0, "foot_sliding": 1.2, "diversity": 20.0, "IRD": 2.0,
}  # fmt: skip


def table(columns, rows, **shared):
    """Rows with these columns, named in one text."""
    return [shared | dict(zip(columns.split(), row, strict=True)) for row in rows]


def about(value, share=0.01):
    """A figure with its interval."""
    return {"value": value, "low": value * (1 - share), "high": value * (1 + share)}


def trained(models, *, windows=2e8, **walk):
    """Tables that say what networks, (model, window), saw, and that they walk, or not."""
    walkers = [("real", window, 0, WALKS) for window in dict.fromkeys(window for _, window in models)]
    walkers += [(*model, 8, WALKS | walk) for model in models]
    return {
        "trained": table("model window_frames metric value", ((*model, "windows", windows) for model in models)),
        "walking": [
            {"model": model, "window_frames": window, "steps": steps, "seed": seed, "style": "walk"} | figures
            for model, window, steps, figures in walkers
            for seed in (0, 1)
        ],
    }


def lengths(rows, seeds=3, of=(0.5, 1.0, 2.0)):
    """Rows of so many trainings that have settled and converged, unless they say of which they are."""
    over = [{"seed": seed, "length": length} for seed in range(seeds) for length in of]
    return [one | row for row in rows for one in (over if "seed" not in row else [{}])]


def keep(root, tables, *, dataset="bandai", profile="laptop", **changes):
    """Write tables (name -> rows) as records of a run, of networks that pass the gate unless they have rows of it."""
    of_networks = [name for name in tables if name in (*OF_TRAINED_NETWORKS, *OF_TEXT)]
    networks = {
        (row["model"], row.get("window_frames", 32)): None
        for name in OF_TRAINED_NETWORKS
        for row in tables.get(name, ())
        if row.get("model", "real") not in REFERENCE_ROWS
    }
    tables = (trained(list(networks)) if networks else {}) | tables
    record = {"dataset": dataset, "profile": profile, "seed": 0, "cores": 2}
    record |= {"device_platform": "gpu", "device_kind": "Test GPU"}
    for name, rows in tables.items():
        rows = lengths(rows) if name in of_networks else rows
        path = root / dataset / profile / "records" / f"{name}.csv"
        write_table(path, pd.DataFrame(rows), record | changes)
    return root


@pytest.fixture(scope="module", autouse=True)
def the_papers_tables_are_judged_once():
    """They say the same of a claim in every test; what is computed changes from test to test."""
    judge_by = claims.Claim.judge
    of_paper = functools.cache(lambda paper, name: judge_by(claims.load_claims(paper)[name], paper_evidence(paper)))

    def judged(claim, evidence):
        is_known = evidence is paper_evidence(claim.paper) and not claim.computed
        return of_paper(claim.paper, claim.id) if is_known else judge_by(claim, evidence)

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(claims.Claim, "judge", judged)
        yield


def judge(root, *claim_ids, datasets=("bandai", "synthetic"), profiles=("gpu", "laptop")):
    """Judge one claim, or all by their ids where none is named."""
    evidences = {data: [recorded_evidence(root, data, p) for p in profiles] for data in datasets}
    known = claims.load_claims()
    found = {name: claims.judge_claim(known[name], evidences) for name in claim_ids or known}
    return found[claim_ids[0]] if claim_ids else found


def times(device, counts, *settings, spread=0.01):
    """Rows of synthesis_time: each setting is (model, ms), or with steps, window, framework."""
    rows = []
    for (model, ms, *rest), count in product(settings, counts):
        setting = (model, *rest, *(8, 32, "jax")[len(rest) :], device, count)
        row = table("model steps window_frames framework device characters", [setting], unit="ms")[0]
        rows.append(row | about(ms(count) if callable(ms) else ms, spread))
    return rows


def quality(model, *, steps=8, window=32, harm=1.0, half=0.01, **values):
    """Rows of all nine metrics, `harm` times worse than usual, some replaced by `values`."""
    rows = []
    for metric, base in BASE.items():
        unit, better = NINE_METRICS[metric]
        value = values.get(metric, base / harm if better == "up" else base * harm)
        row = {"model": model, "window_frames": window, "steps": steps, "metric": metric, "unit": unit, "repeats": 5}
        rows.append(row | about(value, half))
    return rows


def rounds(growth, **others):
    """Figures by round that grow by a share over a rollout; some metrics by another one."""
    wobble = np.random.default_rng(0).normal(1.0, 0.01, 80)
    values = lambda metric: wobble * (1 + others.get(metric, growth) * np.arange(80) / 80)
    metrics = ("gap_m", "FID", "worst_gap_m", "acceleration_cm")
    rows = ((metric, number + 1, value) for metric in metrics for number, value in enumerate(values(metric)))
    return table("metric round value", rows, model=FNO, window_frames=32, steps=8)


def exact(sigma):
    """Error of the exact denoiser of normal numbers with deviation 0.5."""
    return 0.5 * sigma / np.hypot(0.5, sigma)


def over_levels(levels, **curves):
    """Figures by model and noise level; a curve is a function of the level or the figures themselves."""
    models = {"fno": FNO, "ve": VE, "vp": CAMDM}
    figures = {key: map(curve, levels) if callable(curve) else curve for key, curve in curves.items()}
    return [(models[key], *pair) for key, some in figures.items() for pair in zip(levels, some, strict=True)]


OTHER_FNO = ("F3AMD-DCT-96", "F3AMD-weighted-FNO-96", "F3AMD-reduced-rank-FNO-96")
KINDS = [f"{FNO}-{kind}" for kind in ("concatenation", "AdaLN-zero", "cross-attention")]
MODES = [f"{FNO}-m{m}" for m in (14, 12, 8, 4)]


def world(true):
    """Records of a world in which every claim on quality, training and theory holds, or none does."""
    choose = lambda right, wrong: right if true else wrong
    fid = choose(8.0, 12.0)
    camdm = lambda harm, **other: quality(other.pop("model", CAMDM), harm=harm, FID=fid * harm, **other)
    figures = [
        *quality(FNO),
        *quality(T64, EMD=choose(16.2, 20.0)),
        *choose(
            quality("F3AMD-FNO-64", IRD=1.0, FID=15.0, style_coverage=80.0),
            quality("F3AMD-FNO-64", IRD=3.0, FID=5.0, style_coverage=95.0),
        ),
        *quality(CAMDM, FID=fid, IRD=choose(4.0, 1.0), smoothness=choose(3.0, 1.0)),
        *choose(
            quality(PUBLISHED, steps=4, window=45, FID=8.05, trajectory_error=0.1, direction_error=9.0, IRD=6.0),
            quality(PUBLISHED, steps=4, window=45, harm=2.0, trajectory_error=0.01, direction_error=1.0, IRD=0.5),
        ),
        *quality(FNO, window=64, harm=choose(1.2, 2.0)),
        *quality(CAMDM, window=64, FID=choose(40.0, fid)),
        *quality(FNO, steps=4, harm=choose(1.03, 2.0)),
        *quality(FNO, steps=2, harm=choose(1.03, 2.0)),
        *choose(quality(FNO, steps=1, harm=1.03), quality(FNO, steps=1, harm=2.0, diversity=0.1)),
        *camdm(choose(1.1, 1.6), steps=4),
        *camdm(choose(1.6, 1.0), steps=2),
        *camdm(choose(3.0, 1.0), steps=1),
        *camdm(choose(1.1, 2.0), steps=1, model=VE),
        *quality(f"{FNO}-linear", style_coverage=choose(80.0, 95.0), diversity=choose(10.0, 25.0)),
        *quality(f"{FNO}-m1", harm=choose(2.0, 0.5)),
        *(row for model in (*MODES, *OTHER_FNO) for row in quality(model, harm=choose(1.1, 2.0))),
        *(row for model in KINDS for row in quality(model, harm=choose(0.9, 0.5))),
        *quality("CAMDM-96", style_coverage=choose(14.0, 80.0), EMD=choose(40.0, 17.0)),
        *quality(f"{FNO}-no-IRD", IRD=choose(4.0, 1.5)),
    ]
    train = [(CAMDM, 32, choose(2.4, 1.0)), (FNO, 32, 1.0), (T64, 32, choose(1.0, 2.0)), (CAMDM, 64, choose(3.4, 1.0))]
    train += [(FNO, 64, 1.0), (T64, 64, choose(1.6, 0.9)), (FNO_32, 32, 1.0), (FNO_128, 32, choose(2.5, 1.0))]
    memory = {FNO_128: choose(3000.0, 900.0)}
    fine = {FNO: choose(0.5, 1.1), T64: 0.9}
    bands = ((model, band, metric, fine[model] if band == "5-15 Hz" else 1.0)
             for model, band, metric in product(fine, ("0.5-2 Hz", "2-5 Hz", "5-15 Hz"),
                                                ("toe_power", "toe_power_over_real")))  # fmt: skip
    graded = {"EMD": choose((1, 2, 3), (3, 1, 2)), "FID": choose((1, 3, 2), (1, 2, 3))}
    names = ("noisy motion", "frozen pose")
    errors = choose(1.0, 0.5)
    flat = lambda sigma: 0.5  # of a network that ignores its input
    vp = choose(lambda sigma: (1.5 if sigma < 5 else 1.0) * exact(sigma), exact)
    curves = {"fno": choose(exact, flat), "ve": choose(exact, flat), "vp": vp}
    growth = choose((1, 1, 1.5, 2, 3, 3), (3, 3, 2, 2, 1, 1))
    return {
        "quality": figures,
        "synthesis_time": times("GPU", (1024,), (CAMDM, 100.0), (VE, choose(20.0, 60.0), 1)),
        "training_time": [
            row | {"peak_memory_mib": memory.get(row["model"], 1000.0)}
            for row in table("model window_frames value", train, device="GPU", batch_size=512, unit="s")
        ],
        "convergence": table("model value", [(FNO, choose(30, 40)), (CAMDM, choose(40, 30))], metric="FID"),
        "foot_spectrum": [
            row | about(row["value"], 0.05)
            for row in table("model band metric value", bands, window_frames=32, steps=8)
        ],
        "quality_by_round": rounds(choose(0.8, -0.2)),
        "corruptions": [
            {"corruption": name, "strength": strength, "metric": metric, "value": value}
            for name, (metric, values) in product(names, graded.items())
            for strength, value in zip((0.0, 0.5, 1.0), values, strict=True)
        ],
        "x0_by_sigma": table("model sigma x0_error", over_levels((0.01, 0.1, 1.0, 10.0, 128.0), **curves)),
        "recipe_errors": table("recipe value", [("paper", 1.0), ("low-noise-weighting", errors)], model=FNO),
        "gradient_norm": table("model sigma value", over_levels((0.01, 0.1, 1.0, 10.0, 50.0, 128.0), fno=growth)),
    }


def crowds(fno, t64):
    crowd = {"GPU": (128, 256, 512, 1024), "CPU": (16, 32)}
    return sum((times(device, counts, (FNO, fno), (T64, t64)) for device, counts in crowd.items()), [])


def gains(*parts):
    """FNO-96 with 8 steps and with 1; each part is (device, characters, gain)."""
    return sum((times(device, (count,), (FNO, 100.0), (FNO, 100.0 / gain, 1)) for device, count, gain in parts), [])


def over_steps(*parts):
    """FNO-96 at all steps, time = steps^p; each part is (device, characters, p)."""
    settings = lambda p: [(FNO, 10.0 * n**p, n) for n in (8, 4, 2, 1)]
    return sum((times(device, (count,), *settings(p), spread=0.001) for device, count, p in parts), [])


def modes(*saved):
    """FNO-96 and m = 4, which saves so many percent in few, some and many characters."""
    settings = lambda share: [(FNO, 100.0), (f"{FNO}-m4", 100.0 - share)]
    return sum((times("GPU", n, *settings(s), spread=0.001) for n, s in zip((FEW, SOME, MANY), saved, strict=True)), [])


def conditioning(*factors):
    others = zip((KINDS[0], KINDS[2], KINDS[1]), factors, strict=True)
    return times("GPU", (1024,), (FNO, 100.0), *((name, 100.0 * factor) for name, factor in others))


def frameworks(*factors):
    """CAMDM in both; figures are JAX over PyTorch."""
    forms = lambda ms: [(CAMDM, ms), (CAMDM, ms, 8, 32, "iree"), (CAMDM, 100.0, 8, 32, "torch")]
    parts = (("GPU", GPU_FEW), ("GPU", GPU_MANY), ("CPU", CPU_COUNTS))
    return sum((times(*part, *forms(100.0 * factor)) for part, factor in zip(parts, factors, strict=True)), [])


def both_devices(*settings):
    return times("GPU", (1024,), *settings) + times("CPU", (32,), *settings)


def small_against_many(fno_4_8, fno_16_32, transformer):
    large = transformer if callable(transformer) else 100.0 / transformer
    fno = times("CPU", (4, 8), (FNO, 100.0 / fno_4_8)) + times("CPU", (16, 32), (FNO, 100.0 / fno_16_32))
    return times("CPU", CPU_COUNTS, (CAMDM, 100.0), (T64, large)) + fno


def two_kinds(fno, transformer):
    """FNO and Transformer of two widths in few characters."""
    both = (("FNO", fno), ("Transformer", transformer))
    return times("GPU", FEW, *((f"F3AMD-{kind}-{width}", ms) for kind, ms in both for width in (64, 96)))


def at_16_and_1024(*many):
    few = [(CAMDM, 20.0), (FNO, 10.0)]
    return times("GPU", (16,), *few) + times("GPU", (1024,), *many)


def one_step(few, many, cpu):
    """CAMDM over FNO-96 with one step."""
    parts = (("GPU", (16,), few), ("GPU", (1024,), many), ("CPU", CPU_COUNTS, cpu))
    return sum((times(*at, (CAMDM, 10.0 * gain), (FNO, 10.0, 1)) for *at, gain in parts), [])


# Claim on times -> (rows of synthesis_time for which it must hold, rows for which it must not).
TIMES = {
    "E1": (at_16_and_1024((CAMDM, 500.0), (FNO, 100.0)), at_16_and_1024((CAMDM, 150.0), (FNO, 100.0))),
    "E2": tuple(times("GPU", (1024,), (CAMDM, ms), (T64, 100.0)) for ms in (300.0, 200.0)),
    "E3": tuple(
        times("GPU", (1024,), (CAMDM, 500, 8, 64), (FNO, fno, 8, 64), (T64, t64, 8, 64))
        for fno, t64 in ((125, 200), (300, 400))
    ),
    "E4": (small_against_many(6.0, 3.5, 2.5), small_against_many(3.0, 2.0, 1.5)),
    "E5": (crowds(85.0, 100.0), crowds(100.0, 85.0)),
    "E7": (
        gains(("CPU", 1, 6.4), ("CPU", 32, 3.4), ("GPU", 1, 2.9), ("GPU", 1024, 6.5)),
        gains(("CPU", 1, 5.0), ("CPU", 32, 2.0), ("GPU", 1, 2.0), ("GPU", 1024, 5.0)),
    ),
    "E8": (one_step(4, 25, 15), one_step(3, 15, 8)),
    "E9": (modes(3.5, 8.0, 15.5), modes(-5.0, 2.0, 5.0)),
    "E10": (conditioning(2.0, 1.32, 1.09), conditioning(1.5, 1.0, 0.9)),
    "E11": (frameworks(1.1, 0.9, 3.0), frameworks(0.5, 2.0, 0.5)),
    "E12": tuple(
        both_devices((CAMDM, 88.0), (FNO, eight), (FNO, one, 1)) for eight, one in ((22.0, 4.3), (50.0, 20.0))
    ),
    "E14": (two_kinds(5, 5), two_kinds(5, 8)),
    "E15": (
        over_steps(("GPU", 1, 0.5), ("GPU", 1024, 0.95), ("CPU", 1, 0.6), ("CPU", 32, 0.9)),
        over_steps(("GPU", 1, 0.9), ("GPU", 1024, 0.5), ("CPU", 1, 0.9), ("CPU", 32, 0.6)),
    ),
    "E16": tuple(both_devices((FNO_32, 10.0), (FNO_128, ms)) for ms in (25.0, 12.0)),
    "E17": (modes(1.0, 5.0, 12.0), modes(1.0, 2.0, 4.0)),
}
RECORDED = [claim.id for claim in claims.load_claims().values() if not claim.computed]
OF_WORLD = [name for name in RECORDED if name not in TIMES]
SOUND = {"quality": quality(FNO) + quality(f"{FNO}-no-IRD", IRD=4.0)}  # of Q13
WRONG = {"quality": quality(FNO) + quality(f"{FNO}-no-IRD", IRD=1.5)}


@pytest.fixture(scope="module")
def judged(tmp_path_factory):
    """All claims in both worlds."""
    folder = tmp_path_factory.mktemp("worlds")
    found = {}
    for wanted in (HOLDS, FAILS):
        tables = world(wanted == HOLDS)
        # Seen through no classifier that is on record: it cannot lie beside figures of quality.
        root = keep(folder / wanted, {"corruptions": tables.pop("corruptions")}, profile="gpu")
        found[wanted] = judge(keep(root, tables))
    return found


@pytest.mark.parametrize("wanted", [HOLDS, FAILS])
def test_each_rule_passes_its_oracle_and_fails_its_nonsense(judged, wanted):
    found = {name: judged[wanted][name] for name in OF_WORLD}
    assert {name: judgement.verdict for name, judgement in found.items()} == dict.fromkeys(OF_WORLD, wanted)
    for judgement in found.values():
        assert judgement.dataset == "bandai"
        assert all(s.sources for s in judgement.ours if s.verdict not in (UNMEASURED, REMARK))


@pytest.mark.parametrize("claim_id", TIMES)
@pytest.mark.parametrize("wanted", [HOLDS, FAILS])
def test_each_rule_on_times_passes_its_oracle_and_fails_its_nonsense(tmp_path, claim_id, wanted):
    training = world(wanted == HOLDS)["training_time"]
    tables = {"synthesis_time": TIMES[claim_id][wanted == FAILS], "training_time": training}
    judgement = judge(keep(tmp_path, tables), claim_id)
    assert judgement.verdict == wanted and judgement.dataset == "bandai", judgement.ours
    assert all(s.sources for s in judgement.ours if s.verdict not in (UNMEASURED, REMARK))


def textbook_operations(block, frames, width, *sizes):
    """Operations as the paper's formulas have them: nothing but attention, and nothing but the spectral branch."""
    if block is TransformerBlock:
        return 24 * frames * width**2 + 4 * frames**2 * width
    return 8 * sizes[-1] * width**2 + 8 * frames * sizes[-1] * width


def cubic_operations(block, frames, width, *sizes):
    return (10 if block is FNOBlock else 1) * frames**3 * width


# Computed claim -> (what stands in `theory` for it to hold, what stands there for it not to hold).
COMPUTED = {
    "T1": ({}, {"schedules.alpha_bar_from_sigma": lambda sigma: 1.0 / (1.0 + sigma)}),
    "T2": tuple({"_STEPS": theory._STEPS | dict.fromkeys(("rescaled", "printed"), theory._STEPS[name])}
                for name in ("rescaled", "printed")),
    "T3": ({"_operations": textbook_operations}, {"_operations": cubic_operations}),
}  # fmt: skip


@pytest.mark.parametrize("claim_id", COMPUTED)
@pytest.mark.parametrize("wanted", [HOLDS, FAILS])
def test_each_computed_rule_passes_its_oracle_and_fails_its_nonsense(tmp_path, monkeypatch, claim_id, wanted):
    assert {*RECORDED, *COMPUTED} == set(claims.load_claims())
    for name, value in COMPUTED[claim_id][wanted == FAILS].items():
        monkeypatch.setattr(f"f3amd_companion.ledger.theory.{name}", value)
    judgement = judge(tmp_path, claim_id)
    assert judgement.verdict == wanted, judgement.ours


def test_each_rule_says_why_nothing_was_measured(tmp_path):
    for claim_id in RECORDED:
        judgement = judge(tmp_path, claim_id)
        assert judgement.verdict == UNMEASURED and judgement.dataset == "", claim_id


def test_models_of_ours_decide_nothing_of_the_papers(tmp_path):
    """With the -plus preset in place of the paper's, no claim on it holds any more."""
    plus = lambda rows: [row | {"model": f"{FNO}-plus"} if row.get("model") == FNO else row for row in rows]
    found = judge(keep(tmp_path, {name: plus(rows) for name, rows in world(True).items()}))
    asked = lambda claim: repr([s.rule.keywords for s in claim.statements if not s.remark])
    found = [found[name] for name in OF_WORLD if f"'{FNO}'" in asked(claims.load_claims()[name])]
    assert len(found) > 15
    for judgement in found:
        assert judgement.verdict in (UNMEASURED, IN_PART), judgement.claim.id
        assert any(s.verdict == UNMEASURED and FNO in s.figure for s in judgement.ours), judgement.claim.id


# --------------------------------------------------------------------------- figures and verdicts


def test_a_ratio_recovers_its_interval():
    """Of two normal means, the interval of the difference is known: squares add up."""
    one = Figure.of(np.e**2, np.e ** (2 - 0.3), np.e ** (2 + 0.3))
    other = Figure.of(np.e, np.e ** (1 - 0.4), np.e ** (1 + 0.4))
    found = ratio(one, other)
    assert np.allclose([found.value, found.low, found.high], np.exp([1.0, 0.5, 1.5]))


def test_ratios_with_zero_are_told_apart():
    nothing, some = Figure.of(0.0), Figure.of(2.0, 1.0, 4.0)
    assert ratio(nothing, some) == Figure(0.0, 0.0, 0.0)
    assert ratio(some, nothing).value == np.inf and ratio(nothing, nothing).value == 1.0
    refused("means nothing", ratio, Figure.of(-1.0), some)


def test_power_law_and_mean():
    times_ = [Figure.of(3.0 * n**0.7) for n in (8, 4, 2, 1)]
    assert power_law((8, 4, 2, 1), times_).value == pytest.approx(0.7)
    wide = [Figure.of(f.value, 0.9 * f.value, 1.1 * f.value) for f in times_]
    fitted = power_law((8, 4, 2, 1), wide)
    assert fitted.low < 0.7 < fitted.high and fitted.high - fitted.low < 0.4
    assert mean_figure([Figure.of(2.0), Figure.of(8.0)]).value == pytest.approx(4.0)


@pytest.mark.parametrize(
    ("figure", "gain", "verdict"),
    [
        (Figure.of(3.5, 3.1, 3.9), False, HOLDS),
        (Figure.of(3.5, 2.0, 5.0), False, OPEN),  # a value inside a wide interval is no pass
        (Figure.of(2.0, 1.5, 2.5), False, FAILS),
        (Figure.of(2.9, 2.5, 3.3), False, OPEN),
        (Figure.of(6.0, 5.5, 6.5), False, FAILS),
        (Figure.of(6.0, 5.5, 6.5), True, LARGER),
        (Figure.of(4.1, 3.9, 4.3), True, OPEN),
    ],
)
def test_a_stated_range(figure, gain, verdict):
    assert within(figure, (3.0, 4.0), gain=gain) == verdict


def test_an_order_needs_an_interval_that_leaves_out_1():
    assert ordered(Figure.of(1.2, 1.1, 1.3)) == HOLDS
    assert ordered(Figure.of(0.8, 0.7, 0.9)) == FAILS
    assert ordered(Figure.of(1.2, 0.9, 1.5)) == ordered(Figure.of(1.0)) == OPEN


def test_times_of_another_device_fill_gaps_from_another_data_set(tmp_path):
    """E7 is of both devices: one data set was timed on a GPU, the other on a CPU."""
    settings = ("F3AMD-FNO-96", 13.0), ("F3AMD-FNO-96", 2.0, 1)
    keep(tmp_path, {"synthesis_time": times("GPU", [1024], *settings)}, profile="gpu")
    alone = judge(tmp_path, "E7")
    assert [s.verdict for s in alone.ours].count(UNMEASURED) == 3 and alone.times_of == ()
    keep(tmp_path, {"synthesis_time": times("CPU", [1, 32], *settings)}, dataset="synthetic")
    both = judge(tmp_path, "E7")
    assert [s.verdict for s in both.ours].count(UNMEASURED) == 1
    assert (both.dataset, both.times_of) == ("bandai", ("synthetic",))


def test_only_times_fill_gaps(tmp_path):
    """What another data set says of quality is not taken."""
    keep(tmp_path, {"quality": quality(CAMDM, steps=4) + quality(CAMDM)})
    keep(tmp_path, {"quality": quality(CAMDM, steps=2, harm=1.6) + quality(CAMDM)}, dataset="synthetic")
    found = judge(tmp_path, "Q6")
    assert [s.verdict for s in found.ours if not s.remark] == [HOLDS, UNMEASURED, UNMEASURED] and found.times_of == ()


@pytest.mark.parametrize(
    ("parts", "verdict"),
    [
        ([HOLDS, HOLDS, REMARK], HOLDS),
        ([HOLDS, FAILS], IN_PART),
        ([HOLDS, UNMEASURED], IN_PART),
        ([LARGER, OPEN, UNMEASURED], LARGER),
        ([LARGER, FAILS], FAILS),
        ([LARGER, UNJUDGED], UNJUDGED),
        ([FAILS, OPEN, UNMEASURED], FAILS),
        ([OPEN, UNMEASURED], OPEN),
        ([UNMEASURED, REMARK], UNMEASURED),
    ],
)
def test_a_claim_follows_from_its_statements(parts, verdict):
    assert combine(parts) == verdict
    assert every([HOLDS, OPEN]) == OPEN and every([HOLDS, OPEN, FAILS]) == FAILS


@pytest.mark.parametrize(
    ("figures", "verdict"),
    [
        ([HOLDS] * 9, HOLDS),
        ([HOLDS] * 5 + [FAILS] * 4, IN_PART),
        ([HOLDS, FAILS], IN_PART),
        ([HOLDS] * 4 + [FAILS] * 5, FAILS),
        ([HOLDS] * 4 + [FAILS] * 4 + [OPEN], OPEN),
        ([HOLDS] + [LARGER] * 5, LARGER),
    ],
)
def test_a_statement_on_many_figures_goes_by_the_majority(figures, verdict):
    assert majority(figures) == majority(reversed(figures)) == verdict


@pytest.mark.parametrize(
    ("values", "verdict"), [((1, 2, 3), HOLDS), ((1, 3, 2), IN_PART), ((2, 1, 3), FAILS), ((3, 1, 2), FAILS)]
)
def test_an_order_whose_best_is_wrong_does_not_hold(values, verdict):
    evidence = SimpleNamespace(printed=False, figure=lambda _, of, **row: Figure.of(of, 0.99 * of, 1.01 * of))
    assert ranked(evidence, "quality", "FID", [{"of": value} for value in values])[0] == verdict


def test_figures_of_the_same_networks_are_paired():
    """Each loses a tenth, however unlike they are."""
    few = {"a": 1.0, "b": 10.0, "c": 100.0}
    more, few = (Figure.of(37, 1, 100, {one: by * each for one, each in few.items()}) for by in (1.1, 1.0))
    assert ratio(more, few).low == pytest.approx(1.1) and ratio(more, few._replace(trainings=None)).low < 1


# --------------------------------------------------------------------------------------------- the gate

PAIR = [(FNO, 32), (f"{FNO}-no-IRD", 32)]
HALF, ONCE = (lengths(rows["quality"], of=(length,)) for rows, length in ((WRONG, 0.5), (SOUND, 1.0)))


@pytest.mark.parametrize(
    ("tables", "reason"),
    [
        ({"quality": lengths(SOUND["quality"], 1)}, "seen once"),
        ({"quality": lengths(SOUND["quality"], 2)}, "2 seeds of 3"),
        ({"quality": ONCE}, "not seen at half its length"),
        ({"quality": HALF + ONCE}, "not settled: does not hold at half its length"),
        ({"trained": trained(PAIR[:1])["trained"]}, "no record of training"),
        ({"trained": trained(PAIR[:1])["trained"] + trained(PAIR[1:], windows=1e8)["trained"]}, "longer or shorter"),
    ],
)
def test_a_comparison_at_unlike_terms_or_seen_too_little_decides_nothing(tmp_path, tables, reason):
    judgement = judge(keep(tmp_path, SOUND | tables), "Q13")
    assert judgement.verdict == UNJUDGED and reason in claims.statement_table(judgement).loc[0, "ours"]
    assert judge(keep(tmp_path / "sound", SOUND), "Q13").verdict == HOLDS


def test_a_difference_within_the_spread_of_seeds_is_none(tmp_path):
    """Each training is sure of its figure, and another one has another."""
    rows = lengths(SOUND["quality"])
    apart = [row | about(row["value"] * (1 + 0.9 * row["seed"] * (row["model"] == FNO))) for row in rows]
    assert judge(keep(tmp_path, {"quality": apart}), "Q13").verdict == OPEN


@pytest.mark.parametrize(
    ("change", "verdict"),
    [
        ({}, HOLDS),
        (trained([(FNO, 32)], slide_speed=80.0), UNJUDGED),
        ({"recipe_errors": lengths([{"model": FNO, "recipe": "paper", "value": 2.0}], of=(2.0,))}, UNJUDGED),
    ],
)
def test_a_figure_by_itself_is_judged_where_it_converged_and_the_motion_is_plausible(tmp_path, change, verdict):
    once = [{"model": FNO, "recipe": "paper", "value": 1.0}]
    errors = lengths(once, of=(1.0,)) + change.get("recipe_errors", lengths(once, of=(2.0,)))
    spectrum = [row for row in world(True)["foot_spectrum"] if row["model"] == FNO]
    root = keep(tmp_path, {"foot_spectrum": spectrum} | change | {"recipe_errors": errors})
    assert judge(root, "Q15").ours[0].verdict == verdict


def test_converged_means_that_twice_the_length_changes_little():
    once = {"held_out_loss": 1.0, "text_FID": 20.0}
    assert converged(once, {"held_out_loss": 0.96, "text_FID": 20.9})
    for twice in ({"held_out_loss": 0.96, "text_FID": 15.0}, {"held_out_loss": 0.96}, {}):
        assert not converged(once, twice)
    assert not converged({}, {})


def snapshots(root, rows, claim_id="Q10"):
    """Write rows (model, windows, recipe, seed, classifier, worth) of the long queue, all nine metrics of each; judge.

    A worth may be a pair, of what is seen through the classifier and of the others.
    """
    through = {"FID", "EMD", "style_coverage"}
    table = [
        {
            "run": f"{model}-{recipe}-{seed}", "model": model, "windows": windows, "recipe": recipe, "seed": seed,
            "epochs": windows / 100_000,
            "classifier": classifier, "window_frames": 32, "steps": 8, "metric": metric, "unit": unit,
            "value": np.broadcast_to(worth, 2)[int(metric not in through)],
        }
        for model, windows, recipe, seed, classifier, worth in rows
        for metric, (unit, _) in NINE_METRICS.items()
    ]  # fmt: skip
    record = {"dataset": "bandai", "profile": "laptop", "seed": 0, "device_platform": "cpu", "cores": 2}
    write_table(root / "bandai" / "laptop" / "records" / "campaign.csv", pd.DataFrame(table), record)
    evidence = [recorded_evidence(root, "bandai", "laptop"), *snapshot_evidence(root, "bandai", "laptop")]
    return claims.judge_claim(claims.load_claims("f3amd")[claim_id], {"bandai": evidence})


def test_networks_that_the_queue_trained_alike_are_shown_and_decide_nothing(tmp_path):
    models = [FNO, "F3AMD-DCT-96", "F3AMD-weighted-FNO-96", "F3AMD-reduced-rank-FNO-96"]
    alike = [(model, 200_000, "paper", 0, "one", 1.0) for model in models]
    # Other recipes and lengths are other networks.
    others = [(FNO, 200_000, "wide-decoder", 0, "one", 9.0), (FNO, 400_000, "paper", 0, "one", 9.0)]
    judgement = snapshots(tmp_path, [*alike, *others])
    assert judgement.verdict == UNJUDGED and judgement.ours[0].figure.startswith("9 of 9")
    # Seeds are averaged, whatever classifier saw them, and two that differ have a wide interval.
    seeds = snapshots(tmp_path / "seeds", [*alike, (FNO, 200_000, "paper", 1, "another", 1.2)])
    assert f"FID +10 % [-100 %, +137 %] ({FNO} over" in seeds.ours[0].figure
    # Nonsense: one of them is twice as bad, or one of them is missing at this length.
    apart = [*alike[:3], (models[3], 200_000, "paper", 0, "one", 2.0)]
    assert snapshots(tmp_path / "apart", apart).ours[0].figure.startswith("0 of 9")
    missing = [*alike[:3], (models[3], 400_000, "paper", 0, "one", 1.0)]
    assert snapshots(tmp_path / "missing", missing).verdict == UNMEASURED
    # The longest of the lengths that have all of them decides.
    longer = [(model, 800_000, "paper", 0, "one", 2.0) for model in models]
    assert "at 800,000 windows" in str(snapshots(tmp_path / "twice", [*alike, *longer]).ours[0].sources[0])


# ------------------------------------------------------------------------- whose records decide


def test_real_motion_decides_before_synthetic_where_it_can(tmp_path):
    keep(tmp_path, SOUND, dataset="synthetic")
    assert judge(tmp_path, "Q13").verdict == HOLDS
    keep(tmp_path, {"quality": lengths(WRONG["quality"], 1)}, dataset="bandai")
    assert judge(tmp_path, "Q13").dataset == "synthetic"  # the other has figures alone
    keep(tmp_path, WRONG, dataset="bandai")
    assert judge(tmp_path, "Q13").verdict == FAILS


GOOD = SOUND["quality"]
ON_GPU = times("GPU", (1024,), (CAMDM, 300.0), (T64, 100.0))


@pytest.mark.parametrize(
    ("claim_id", "tables", "message"),
    [
        ("Q13", {"quality": GOOD + GOOD[:1]}, "two rows of"),
        ("Q13", {"quality": [{**GOOD[3], "unit": "cm"}]}, "another unit than the paper of .*trajectory_error"),
        ("E2", {"synthesis_time": [{**ON_GPU[0], "device": "gpu"}]}, "device must be CPU or GPU"),
        ("Q13", {"quality": [{**GOOD[-1], "low": 9.0}]}, "outside its interval"),
    ],
)
def test_a_broken_table_is_an_error(tmp_path, claim_id, tables, message):
    keep(tmp_path, tables)
    refused(message, judge, tmp_path, claim_id)


def test_a_foreign_or_lost_record_is_an_error(tmp_path):
    keep(tmp_path, SOUND, dataset="synthetic")
    (tmp_path / "synthetic").rename(tmp_path / "bandai")
    refused("is a record of synthetic and laptop; move it", judge, tmp_path, "Q13")
    (tmp_path / "bandai" / "laptop" / "records" / "quality.json").unlink()
    refused("no readable run record", judge, tmp_path, "Q13")


# ------------------------------------------------------------------------------ the file of claims

STATEMENT = {"says": "FNO is worse", "kind": "worse", "model": FNO, "against": CAMDM, "metric": "FID"}


def read(statement):
    """Read a file of one claim with one statement."""
    entry = {"id": "Q1", "text": "worse", "where": "1", "decided_by": "FID", "statement": [statement]}
    families = {"FNO": {"models": [FNO, "F3AMD-FNO-64"], "required": [FNO]}}
    file = {"groups": {"Q": "Quality"}, "thresholds": {"minor": 1.3}, "families": families, "claim": [entry]}
    return claims.read_claims(file, "f3amd", "f.toml")


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        (STATEMENT | {"kind": "wors"}, "unknown kind of judgement 'wors'; did you mean 'worse'"),
        (STATEMENT | {"model": "FNO-96"}, "unknown model 'FNO-96'"),
        (STATEMENT | {"model": {"model": FNO, "step": 1}}, "unknown key 'step'; did you mean 'steps'"),
        (STATEMENT | {"within": [0, 1], "alike": 0.1}, "unexpected keyword argument 'alike'"),
        (STATEMENT | {"about": [5, 2, 1]}, "stated_factor.. takes from 1 to 2 positional"),
        (STATEMENT | {"within": [0, "miner"]}, "unknown threshold 'miner'; did you mean 'minor'"),
        (STATEMENT | {"metric": "FD"}, "unknown metric 'FD'; did you mean 'FID'"),
        ({key: STATEMENT[key] for key in STATEMENT if key != "metric"}, "missing a required argument: 'metric'"),
    ],
)
def test_a_broken_statement_is_an_error(statement, message):
    refused(f"f.toml, claim Q1, '{statement['says']}': .*{message}", read, statement)


# ---------------------------------------------------------------------------- the ledger itself


@pytest.mark.parametrize("data", ["bandai", "synthetic"])
def test_the_ledger_among_a_data_sets_tables_is_the_accepted_one(data):
    """Notebook 08 leaves it there, whatever data it was run on."""
    table, _ = committed_table(data, "08_claims", kind="tables")
    accepted = {claim_id: entry["verdict"] for claim_id, entry in claims.accepted_verdicts().items()}
    assert dict(zip(table.id, table.verdict, strict=True)) == accepted, f"f3amd figures --data {data} --only 08"


@pytest.mark.parametrize(("paper", "count"), [("f3amd", 43), ("acmdm", 17), ("motionpcm", 13)])
def test_the_committed_page_and_verdicts_follow_from_the_committed_records(paper, count):
    judgements, path = claims.judge_claims(paper=paper), claims.ledger_path(paper)
    frame = claims.ledger(judgements)
    changes = claims.changed_verdicts(frame, claims.accepted_verdicts(path))
    assert not changes, "\n".join(changes) + "\nIf these are right: scripts/claims_page.py --accept"
    assert path.read_text(encoding="utf-8") == claims_page.ledger_markdown(judgements), (
        f"{path}: scripts/claims_page.py"
    )
    assert len(frame) == count and set(frame["verdict"]) | set(frame["paper_verdict"]) <= set(VERDICTS)
    measured = frame[~frame["verdict"].isin([UNMEASURED]) & (frame["dataset"] != "computed")]
    assert (measured[["dataset", "hardware", "record"]] != "").all(axis=None)


def test_a_changed_verdict_is_noticed_until_it_is_accepted(tmp_path):
    holds, fails = ([judge(keep(tmp_path / str(i), tables), "Q13")] for i, tables in enumerate((SOUND, WRONG)))
    path = tmp_path / "claims.md"
    assert claims_page.write_ledger(path, holds) and not path.exists()
    claims_page.write_ledger(path, holds, accept=True)
    page = path.read_text()
    assert claims_page.write_ledger(path, holds) == []
    (change,) = claims_page.write_ledger(path, fails)
    assert change.startswith("Q13 by our records: was 'holds', is 'does not hold' (") and path.read_text() == page
    claims_page.write_ledger(path, fails, accept=True)
    assert claims.accepted_verdicts(path)["Q13"]["verdict"] == FAILS


def test_slack_leaves_half_of_a_small_gain_and_is_the_same_up_and_down():
    assert equal_range(0.25) == pytest.approx((0.8, 1.25))
    assert stated_factor(1.04) == pytest.approx((1.02, 1.06))
    low, high = stated_factor(10.0, 2.0)
    assert (low, high) == pytest.approx((5.0 * (1.0 - TOLERANCE), 5.0 * (1.0 + TOLERANCE)))
