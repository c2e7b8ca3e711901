"""The claims ledger: every rule on made-up records, the paper's own tables, accepted verdicts."""

import dataclasses

import numpy as np
import pandas as pd
import pytest

from f3amd_companion.ledger import claims, theory
from f3amd_companion.ledger.evidence import (
    OF_TRAINED_NETWORKS,
    Figure,
    NotMeasured,
    Setting,
    mean_figure,
    paper_evidence,
    power_law,
    ratio,
    recorded_evidence,
    snapshot_evidence,
)
from f3amd_companion.ledger.judgements import (
    FAILS,
    HOLDS,
    IN_PART,
    LARGER,
    OPEN,
    REMARK,
    UNJUDGED,
    UNMEASURED,
    VERDICTS,
    combine,
    every,
    majority,
    ordered,
    within,
)
from f3amd_companion.speed.timing import median_interval
from f3amd_lib.diffusion import samplers
from f3amd_lib.ground import papers
from f3amd_lib.ground.records import read_table, write_table
from f3amd_lib.networks.attention import TransformerBlock
from f3amd_lib.networks.spectral import FNOBlock
from f3amd_lib.papers.printed import NINE_METRICS, REFERENCE_ROWS

# --------------------------------------------------------------------------------- made-up records

FNO, T64, CAMDM = "F3AMD-FNO-96", "F3AMD-Transformer-64", "CAMDM"
GPU_FEW, GPU_MANY = (1, 2, 4, 8, 16), (32, 64, 128, 256, 512, 1024)
FEW, SOME, MANY = (1, 2, 4, 8), (16, 32, 64, 128), (256, 512, 1024)
CPU_COUNTS = (1, 2, 4, 8, 16, 32)
LARGE_CROWD = {"GPU": (128, 256, 512, 1024), "CPU": (16, 32)}


WALKS = {"stepping_rate": 1.8, "joint_acceleration": 1.0, "slide_speed": 5.0, "floor_penetration": 0.2}


def trained(models, *, windows=2e8, fall=0.01, **walk):
    """Rows that let networks pass the gate, or not."""
    figures = {"windows": windows, "held_out_fall": fall}
    return {
        "trained": [
            {"model": model, "window_frames": window, "metric": metric, "value": value}
            for model, window in models
            for metric, value in figures.items()
        ],
        "walking": [
            {"model": model, "window_frames": window, "steps": steps, "seed": seed, "style": "walk"} | WALKS | changed
            for model, window, steps, changed in [
                *(("real", window, 0, {}) for window in dict.fromkeys(window for _, window in models)),
                *((name, window, 8, walk) for name, window in models),
            ]
            for seed in (0, 1)
        ],
    }


def keep(root, tables, *, dataset="bandai", profile="laptop", **changes):
    """Write tables (name -> rows) as records of a run, of networks that pass the gate unless they have rows of it."""
    networks = {
        (row["model"], row.get("window_frames", 32)): None
        for name in OF_TRAINED_NETWORKS
        for row in tables.get(name, ())
        if row.get("model", "real") not in REFERENCE_ROWS
    }
    tables = (trained(list(networks)) if networks else {}) | tables
    record = {
        "dataset": dataset,
        "profile": profile,
        "seed": 0,
        "device_platform": "gpu",
        "device_kind": "Test GPU",
        "cores": 2,
    }
    for name, rows in tables.items():
        path = root / dataset / profile / "records" / f"{name}.csv"
        write_table(path, pd.DataFrame(rows), {**record, **changes})
    return root


def judge(root, claim_id, datasets=("bandai", "synthetic"), profiles=("gpu", "laptop")):
    evidences = {data: [recorded_evidence(root, data, p) for p in profiles] for data in datasets}
    return claims.judge_claim(claims.load_claims()[claim_id], evidences)


def times(device, counts, *settings, spread=0.01):
    """Rows of synthesis_time: each setting is (model, ms), or with steps, window, framework."""
    rows = []
    for model, value, *rest in settings:
        steps, window, framework = (*rest, *(8, 32, "jax")[len(rest) :])
        for count in counts:
            ms = value(count) if callable(value) else value
            rows.append(
                {
                    "model": model,
                    "window_frames": window,
                    "steps": steps,
                    "framework": framework,
                    "device": device,
                    "characters": count,
                    "unit": "ms",
                    "value": ms,
                    "low": ms * (1 - spread),
                    "high": ms * (1 + spread),
                }
            )
    return rows


def synthesis(*parts):
    return {"synthesis_time": [row for part in parts for row in part]}


def training(*rows):
    columns = ("model", "window_frames", "value", "peak_memory_mib")
    fixed = {"device": "GPU", "batch_size": 512, "unit": "s"}
    return [dict(zip(columns, row, strict=False)) | fixed for row in rows]


BASE = {
    "FID": 10.0,
    "EMD": 16.0,
    "style_coverage": 90.0,
    "trajectory_error": 0.03,
    "direction_error": 3.0,
    "smoothness": 2.0,
    "foot_sliding": 1.2,
    "diversity": 20.0,
    "IRD": 2.0,
}


def quality(model, *, steps=8, window=32, harm=1.0, half=0.01, **values):
    """Rows of all nine metrics, `harm` times worse than usual, some replaced by `values`."""
    rows = []
    for metric, base in BASE.items():
        unit, better = NINE_METRICS[metric]
        value = values.get(metric, base / harm if better == "up" else base * harm)
        rows.append(
            {
                "model": model,
                "window_frames": window,
                "steps": steps,
                "metric": metric,
                "unit": unit,
                "value": value,
                "low": value * (1 - half),
                "high": value * (1 + half),
                "repeats": 5,
            }
        )
    return rows


def qualities(*parts):
    return {"quality": [row for part in parts for row in part]}


def epochs(**reached):
    """Curves over 100 epochs that come close to their best at a given epoch."""
    models = {"fno": FNO, "camdm": CAMDM}
    return {
        "quality_by_epoch": [
            {"model": models[key], "epoch": epoch, "metric": metric, "value": value}
            for key, epoch_reached in reached.items()
            for metric in ("held_out_loss", "style_coverage")
            for epoch in range(1, 101)
            for value in [
                (1.0 if metric == "held_out_loss" else 90.0)
                if epoch >= epoch_reached
                else (2.0 if metric == "held_out_loss" else 40.0)
            ]
        ]
    }


def spectrum(fno, transformer):
    """Power of toes over real; lower bands are those of real motion."""
    return {
        "foot_spectrum": [
            {
                "model": model,
                "window_frames": 32,
                "steps": 8,
                "band": band,
                "metric": metric,
                "value": power,
                "low": 0.95 * power,
                "high": 1.05 * power,
            }
            for model, fine in ((FNO, fno), (T64, transformer))
            for band, power in (("0.5-2 Hz", 1.0), ("2-5 Hz", 1.0), ("5-15 Hz", fine))
            for metric in ("toe_power", "toe_power_over_real")
        ]
    }


def rounds(growth, **others):
    """Figures by round that grow by a share over a rollout; some metrics by another one."""
    wobble = np.random.default_rng(0).normal(1.0, 0.01, 80)
    return {
        "quality_by_round": [
            {
                "model": FNO,
                "window_frames": 32,
                "steps": 8,
                "metric": metric,
                "round": number + 1,
                "value": wobble[number] * (1 + others.get(metric, growth) * number / 80),
            }
            for metric in ("gap_m", "FID", "worst_gap_m", "acceleration_cm")
            for number in range(80)
        ]
    }


def graded(emd, fid):
    return {
        "corruptions": [
            {"corruption": name, "strength": strength, "metric": metric, "value": value}
            for name in ("noisy motion", "frozen pose")
            for metric, values in (("EMD", emd), ("FID", fid))
            for strength, value in zip((0.0, 0.5, 1.0), values, strict=True)
        ]
    }


def exact(sigma):
    """Error of the exact denoiser of normal numbers with deviation 0.5."""
    return 0.5 * sigma / np.hypot(0.5, sigma)


def x0_errors(fno, ve, vp):
    return {
        "x0_by_sigma": [
            {"model": model, "sigma": sigma, "x0_error": error(sigma)}
            for model, error in ((FNO, fno), ("CAMDM-VE", ve), (CAMDM, vp))
            for sigma in (0.01, 0.1, 1.0, 10.0, 128.0)
        ]
    }


def recipe_errors(*errors):
    """Joint errors with the scaled loss at 8 steps and at 1; without it they are 1 cm."""
    return {
        "recipes": [
            {"recipe": recipe, "steps": steps, "joint_error_cm": error if recipe != "paper" else 1.0}
            for recipe in ("paper", "low-noise-weighting")
            for steps, error in zip((8, 1), errors, strict=True)
        ]
    }


def gradient(values):
    return {
        "gradient_norm": [
            {"model": "F3AMD-FNO-96", "sigma": sigma, "value": value}
            for sigma, value in zip((0.01, 0.1, 1.0, 10.0, 50.0, 128.0), values, strict=True)
        ]
    }


def crowds(fno, t64):
    return synthesis(*(times(device, counts, (FNO, fno), (T64, t64)) for device, counts in LARGE_CROWD.items()))


def steps_times(gains):
    """FNO-96 with 8 and 1 steps; gains by (device, characters)."""
    return synthesis(
        *(times(device, (count,), (FNO, 100.0), (FNO, 100.0 / gain, 1)) for (device, count), gain in gains.items())
    )


def over_steps(exponents):
    """FNO-96 at all steps, time = steps^p; p by (device, characters)."""
    return synthesis(
        *(
            times(device, (count,), *((FNO, 10.0 * n**p, n) for n in (8, 4, 2, 1)), spread=0.001)
            for (device, count), p in exponents.items()
        )
    )


def modes(few, some, many):
    """FNO-96 and m = 4, which saves so many percent."""
    parts = ((FEW, few), (SOME, some), (MANY, many))
    return synthesis(
        *(times("GPU", counts, (FNO, 100.0), (f"{FNO}-m4", 100.0 - saved), spread=0.001) for counts, saved in parts)
    )


def conditioning(concatenation, cross_attention, adaln):
    others = {"concatenation": concatenation, "cross-attention": cross_attention, "AdaLN-zero": adaln}
    settings = [(f"{FNO}-{kind}", 100.0 * factor) for kind, factor in others.items()]
    return synthesis(times("GPU", (1024,), (FNO, 100.0), *settings))


def frameworks(gpu_few, gpu_many, cpu):
    """CAMDM in both; figures are JAX over PyTorch."""
    parts = (("GPU", GPU_FEW, gpu_few), ("GPU", GPU_MANY, gpu_many), ("CPU", CPU_COUNTS, cpu))
    return synthesis(
        *(
            times(
                device,
                counts,
                (CAMDM, 100.0 * factor),
                (CAMDM, 100.0 * factor, 8, 32, "iree"),
                (CAMDM, 100.0, 8, 32, "torch"),
            )
            for device, counts, factor in parts
        )
    )


def headline(camdm, fno_8, fno_1):
    return synthesis(
        *(
            times(device, (crowd,), (CAMDM, camdm), (FNO, fno_8), (FNO, fno_1, 1))
            for device, crowd in (("GPU", 1024), ("CPU", 32))
        )
    )


def widths(time, train, memory):
    """FNO-128 over FNO-32."""
    small, large = "F3AMD-FNO-32", "F3AMD-FNO-128"
    pairs = ((small, 10.0), (large, 10.0 * time))
    return {
        **synthesis(times("GPU", (1024,), *pairs), times("CPU", (32,), *pairs)),
        "training_time": training((small, 32, 1.0, 1000.0), (large, 32, train, 1000.0 * memory)),
    }


def small_against_many(fno_4_8, fno_16_32, transformer):
    return synthesis(
        times("CPU", CPU_COUNTS, (CAMDM, 100.0), (T64, transformer if callable(transformer) else 100.0 / transformer)),
        times("CPU", (4, 8), (FNO, 100.0 / fno_4_8)),
        times("CPU", (16, 32), (FNO, 100.0 / fno_16_32)),
    )


def variants(names, harm):
    return qualities(quality(FNO), *(quality(name, harm=harm) for name in names))


OTHER_FNO = ("F3AMD-DCT-96", "F3AMD-weighted-FNO-96", "F3AMD-reduced-rank-FNO-96")
KINDS = [f"{FNO}-{kind}" for kind in ("concatenation", "AdaLN-zero", "cross-attention")]
MODES = [f"{FNO}-m{m}" for m in (14, 12, 8, 4)]

# Claim -> (tables for which it must hold, tables for which it must not).
CASES = {
    "E1": (
        synthesis(times("GPU", (16,), (CAMDM, 20.0), (FNO, 10.0)), times("GPU", (1024,), (CAMDM, 500.0), (FNO, 100.0))),
        synthesis(times("GPU", (16,), (CAMDM, 20.0), (FNO, 10.0)), times("GPU", (1024,), (CAMDM, 150.0), (FNO, 100.0))),
    ),
    "E2": (
        synthesis(times("GPU", (1024,), (CAMDM, 300.0), (T64, 100.0))),
        synthesis(times("GPU", (1024,), (CAMDM, 200.0), (T64, 100.0))),
    ),
    "E3": (
        synthesis(times("GPU", (1024,), (CAMDM, 500, 8, 64), (FNO, 125, 8, 64), (T64, 200, 8, 64))),
        synthesis(times("GPU", (1024,), (CAMDM, 500, 8, 64), (FNO, 300, 8, 64), (T64, 400, 8, 64))),
    ),
    "E4": (small_against_many(6.0, 3.5, 2.5), small_against_many(3.0, 2.0, 1.5)),
    "E5": (crowds(85.0, 100.0), crowds(100.0, 85.0)),
    "E6": (
        {"training_time": training((CAMDM, 32, 2.5), (FNO, 32, 1.0), (CAMDM, 64, 3.4), (FNO, 64, 1))},
        {"training_time": training((CAMDM, 32, 1.0), (FNO, 32, 1.0), (CAMDM, 64, 1.0), (FNO, 64, 1))},
    ),
    "E7": (
        steps_times({("CPU", 1): 6.4, ("CPU", 32): 3.4, ("GPU", 1): 2.9, ("GPU", 1024): 6.5}),
        steps_times({("CPU", 1): 5.0, ("CPU", 32): 2.0, ("GPU", 1): 2.0, ("GPU", 1024): 5.0}),
    ),
    "E8": (
        synthesis(
            times("GPU", (16,), (CAMDM, 40.0), (FNO, 10.0, 1)),
            times("GPU", (1024,), (CAMDM, 250.0), (FNO, 10.0, 1)),
            times("CPU", CPU_COUNTS, (CAMDM, 150.0), (FNO, 10.0, 1)),
        ),
        synthesis(
            times("GPU", (16,), (CAMDM, 30.0), (FNO, 10.0, 1)),
            times("GPU", (1024,), (CAMDM, 150.0), (FNO, 10.0, 1)),
            times("CPU", CPU_COUNTS, (CAMDM, 80.0), (FNO, 10.0, 1)),
        ),
    ),
    "E9": (modes(3.5, 8.0, 15.5), modes(-5.0, 2.0, 5.0)),
    "E10": (conditioning(2.0, 1.32, 1.09), conditioning(1.5, 1.0, 0.9)),
    "E11": (frameworks(1.1, 0.9, 3.0), frameworks(0.5, 2.0, 0.5)),
    "E12": (headline(88.0, 22.0, 4.3), headline(88.0, 50.0, 20.0)),
    "E13": (epochs(fno=30, camdm=40), epochs(fno=40, camdm=30)),
    "E14": (
        synthesis(times("GPU", FEW, *((f"F3AMD-{k}-{w}", 5) for k in ("FNO", "Transformer") for w in (64, 96)))),
        synthesis(
            times("GPU", FEW, *((f"F3AMD-{k}-{w}", t) for k, t in (("FNO", 5), ("Transformer", 8)) for w in (64, 96)))
        ),
    ),
    "E15": (
        over_steps({("GPU", 1): 0.5, ("GPU", 1024): 0.95, ("CPU", 1): 0.6, ("CPU", 32): 0.9}),
        over_steps({("GPU", 1): 0.9, ("GPU", 1024): 0.5, ("CPU", 1): 0.9, ("CPU", 32): 0.6}),
    ),
    "E16": (widths(2.5, 2.5, 3.0), widths(1.2, 1.0, 0.9)),
    "E17": (modes(1.0, 5.0, 12.0), modes(1.0, 2.0, 4.0)),
    "Q1": (
        qualities(quality(FNO, half=0.001), quality(T64, EMD=16.4), quality(CAMDM, EMD=16.2)),
        qualities(quality(FNO, half=0.001), quality(T64, EMD=20.0), quality(CAMDM, EMD=16.2)),
    ),
    "Q2": (
        qualities(quality(T64), quality("F3AMD-FNO-64", IRD=1.0, FID=15.0, style_coverage=80.0)),
        qualities(quality(T64), quality("F3AMD-FNO-64", IRD=3.0, FID=5.0, style_coverage=95.0)),
    ),
    "Q3": (
        qualities(quality(FNO), quality(T64), quality(CAMDM, FID=8.0, IRD=4.0)),
        qualities(quality(FNO), quality(T64), quality(CAMDM, FID=12.0, IRD=1.0)),
    ),
    "Q4": (
        qualities(quality(FNO), quality(FNO, window=64, harm=1.2), quality(CAMDM), quality(CAMDM, window=64, FID=40.0)),
        qualities(quality(FNO), quality(FNO, window=64, harm=2.0), quality(CAMDM), quality(CAMDM, window=64)),
    ),
    "Q5": (
        qualities(quality(FNO), *(quality(FNO, steps=n, harm=1.03) for n in (4, 2, 1))),
        qualities(*(quality(FNO, steps=n, diversity=0.1) for n in (8, 4, 2, 1))),  # one motion for all noise
    ),
    "Q6": (
        qualities(*(quality(CAMDM, steps=n, harm=h) for n, h in ((8, 1), (4, 1.1), (2, 1.6), (1, 3)))),
        qualities(*(quality(CAMDM, steps=n, harm=h) for n, h in ((8, 1), (4, 1.6), (2, 1.0), (1, 1)))),
    ),
    "Q7": (
        {
            **qualities(quality(CAMDM), quality("CAMDM-VE", steps=1, harm=1.1)),
            **synthesis(times("CPU", (32,), (CAMDM, 100.0), ("CAMDM-VE", 20.0, 1))),
        },
        {
            **qualities(quality(CAMDM), quality("CAMDM-VE", steps=1, harm=2.0)),
            **synthesis(times("CPU", (32,), (CAMDM, 100.0), ("CAMDM-VE", 60.0, 1))),
        },
    ),
    "Q8": (
        qualities(quality(FNO), quality(f"{FNO}-linear", style_coverage=80.0, diversity=10.0)),
        qualities(quality(FNO), quality(f"{FNO}-linear", style_coverage=95.0, diversity=25.0)),
    ),
    "Q9": (
        qualities(quality(FNO), quality(f"{FNO}-m1", harm=2.0), *(quality(m, harm=1.1) for m in MODES)),
        qualities(quality(FNO), quality(f"{FNO}-m1", harm=0.5), *(quality(m, harm=2.0) for m in MODES)),
    ),
    "Q10": (variants(OTHER_FNO, 1.1), variants(OTHER_FNO, 2.0)),
    "Q11": (variants(KINDS, 0.9), variants(KINDS, 0.5)),
    "Q12": (
        qualities(quality(FNO), quality("CAMDM-96", style_coverage=14.0, EMD=40.0)),
        qualities(quality(FNO), quality("CAMDM-96", style_coverage=80.0, EMD=17.0)),
    ),
    "Q13": (
        qualities(quality(FNO), quality(f"{FNO}-no-IRD", IRD=4.0)),
        qualities(quality(FNO), quality(f"{FNO}-no-IRD", IRD=1.5)),
    ),
    "Q14": (
        qualities(quality(FNO), quality(FNO, steps=1, diversity=15.0)),
        qualities(quality(FNO), quality(FNO, steps=1, diversity=0.1)),
    ),
    "Q15": (spectrum(0.5, 0.9), spectrum(1.1, 0.9)),
    "Q16": (rounds(0.8), rounds(-0.2)),
    "Q17": (
        qualities(
            quality(CAMDM, smoothness=3.0),
            quality("CAMDM published", trajectory_error=0.1, direction_error=9.0, IRD=4.0),
        ),
        qualities(
            quality(CAMDM, smoothness=1.0),
            quality("CAMDM published", trajectory_error=0.01, direction_error=1.0, IRD=1.0),
        ),
    ),
    "E18": (
        {"training_time": training((T64, 32, 1.0), (FNO, 32, 1.0), (CAMDM, 32, 2.3), (T64, 64, 1.6), (FNO, 64, 1.0))},
        {"training_time": training((T64, 32, 2.0), (FNO, 32, 1.0), (CAMDM, 32, 2.3), (T64, 64, 0.9), (FNO, 64, 1.0))},
    ),
    "Q19": (
        {"quality": quality(CAMDM) + quality("CAMDM published", steps=4, window=45, harm=1.01)},
        {"quality": quality(CAMDM) + quality("CAMDM published", steps=4, window=45, harm=2.0)},
    ),
    "T6": (recipe_errors(1.0, 1.1), recipe_errors(0.5, 0.6)),
    "Q18": (graded((1, 2, 3), (1, 3, 2)), graded((3, 1, 2), (1, 2, 3))),
    "T4": (
        x0_errors(exact, exact, lambda sigma: 1.5 * exact(sigma) if sigma < 5 else exact(sigma)),
        x0_errors(lambda sigma: 0.5, lambda sigma: 0.5, exact),  # a network that ignores its input
    ),
    "T5": (gradient((1, 1, 1.5, 2, 3, 3)), gradient((3, 3, 2, 2, 1, 1))),
}

RECORDED = [claim.id for claim in claims.load_claims().values() if not claim.computed]


def textbook_operations(block, frames, width, *sizes):
    """Operations as the paper's formulas have them: nothing but attention, and nothing but the spectral branch."""
    if block is TransformerBlock:
        return 24 * frames * width**2 + 4 * frames**2 * width
    modes = sizes[-1]
    return 8 * modes * width**2 + 8 * frames * modes * width


def cubic_operations(block, frames, width, *sizes):
    return (10 if block is FNOBlock else 1) * frames**3 * width


# Computed claim -> (what stands in `theory` for it to hold, what stands there for it not to hold).
COMPUTED = {
    "T1": ({}, {"schedules.alpha_bar_from_sigma": lambda sigma: 1.0 / (1.0 + sigma)}),
    "T2": (
        {"_STEPS": dict.fromkeys(("rescaled", "printed"), theory._rescaled_step)},
        {"_STEPS": dict.fromkeys(("rescaled", "printed"), samplers.ddim_step_literal)}
        | {"_rescaled_step": samplers.ddim_step_literal},
    ),
    "T3": ({"_operations": textbook_operations}, {"_operations": cubic_operations}),
}


def test_every_claim_has_an_oracle_and_a_nonsense():
    assert [*CASES, *COMPUTED] and {*CASES, *COMPUTED} == set(claims.load_claims())
    assert set(CASES) == set(RECORDED)
    assert all(len(cases) == 2 for cases in (CASES | COMPUTED).values())


@pytest.mark.parametrize("claim_id", RECORDED)
@pytest.mark.parametrize("wanted", [HOLDS, FAILS])
def test_each_rule_passes_its_oracle_and_fails_its_nonsense(tmp_path, claim_id, wanted):
    tables = CASES[claim_id][wanted == FAILS]
    judgement = judge(keep(tmp_path, tables), claim_id)
    assert judgement.verdict == wanted, judgement.ours
    assert judgement.dataset == "bandai"
    assert all(s.sources for s in judgement.ours if s.verdict not in (UNMEASURED, REMARK))


@pytest.mark.parametrize("claim_id", COMPUTED)
@pytest.mark.parametrize("wanted", [HOLDS, FAILS])
def test_each_computed_rule_passes_its_oracle_and_fails_its_nonsense(tmp_path, monkeypatch, claim_id, wanted):
    for name, value in COMPUTED[claim_id][wanted == FAILS].items():
        monkeypatch.setattr(f"f3amd_companion.ledger.theory.{name}", value)
    judgement = judge(tmp_path, claim_id)
    assert judgement.verdict == wanted, judgement.ours


def apart(model, *, kept=("EMD",), **settings):
    """Rows of a model that is 1,000 times worse in all metrics but some."""
    usual = {metric: BASE[metric] for metric in kept}
    return quality(model, harm=1000.0, **usual, **settings)


USUAL = [quality(FNO), quality(CAMDM)]
# Claim -> tables that one metric, or one figure, of many would have saved.
ONE_OF_MANY = {
    "Q4": qualities(*USUAL, apart(FNO, window=64), quality(CAMDM, window=64)),
    "Q5": qualities(quality(FNO), *(apart(FNO, steps=n, kept=("EMD", "diversity")) for n in (4, 2, 1))),
    "Q9": qualities(
        quality(FNO), quality(f"{FNO}-m1", harm=0.5, EMD=40.0), *(apart(f"{FNO}-m{m}") for m in (14, 12, 8, 4))
    ),
    "Q10": qualities(quality(FNO), *map(apart, OTHER_FNO)),
    "Q11": qualities(quality(FNO), *map(apart, KINDS)),
    "Q16": rounds(-0.2, gap_m=0.8),
    "E4": small_against_many(3.0, 2.0, lambda count: 100.0 / (2.5 if count == 1 else 1.5)),
    "E14": synthesis(
        times(
            "GPU",
            FEW,
            *((f"F3AMD-FNO-{w}", 5.0) for w in (64, 96)),
            *((f"F3AMD-Transformer-{w}", lambda count: 5.0 if count == 1 else 8.0) for w in (64, 96)),
        )
    ),
}


@pytest.mark.parametrize("claim_id", ONE_OF_MANY)
def test_one_of_many_figures_saves_nothing(tmp_path, claim_id):
    judgement = judge(keep(tmp_path, ONE_OF_MANY[claim_id]), claim_id)
    assert judgement.verdict == FAILS, judgement.ours


KEYS = ("use_of_x", "use_of_sigma")


@pytest.mark.parametrize(
    ("uses", "expected"),
    [((0.6, 1.6), "0.6 cm with the noisy input, 1.6 cm with the noise level alone"),
     ((2.4, 0.0), "2.4 cm with the noisy input, 0 cm with the noise level alone")],
)  # fmt: skip
def test_the_remark_on_q5_tells_use_of_the_input_from_use_of_the_level(tmp_path, uses, expected):
    rows = [{"model": FNO, "metric": key, "value": use} for key, use in zip(KEYS, uses, strict=True)]
    remarks = [s.figure for s in judge(keep(tmp_path, {"input_use": rows}), "Q5").ours if s.verdict == REMARK]
    assert remarks == [expected]


def test_a_metric_that_is_better_is_not_called_worse(tmp_path):
    tables = qualities(*(quality(CAMDM, steps=n, harm=h) for n, h in ((8, 1.0), (4, 0.6), (2, 1.6), (1, 3.0))))
    texts = [s.figure for s in judge(keep(tmp_path, tables), "Q6").ours if s.verdict != REMARK]
    assert [text.split(",")[0] for text in texts] == ["FID 40 % better", "FID 60 % worse", "FID 3x worse"]


@pytest.mark.parametrize("claim_id", RECORDED)
def test_each_rule_says_why_nothing_was_measured(tmp_path, claim_id):
    judgement = judge(tmp_path, claim_id)
    assert judgement.verdict == UNMEASURED and judgement.dataset == ""
    assert all(s.figure.endswith(".csv yet") for s in judgement.ours)


RESTING_ON_FNO_96 = [
    claim_id
    for claim_id in RECORDED
    if any(row.get("model") == FNO for rows in CASES[claim_id][0].values() for row in rows)
]


@pytest.mark.parametrize("claim_id", RESTING_ON_FNO_96)
def test_models_of_ours_decide_nothing_of_the_papers(tmp_path, claim_id):
    """With the -plus preset in place of the paper's, no claim holds any more."""
    tables = {
        name: [{**row, "model": f"{FNO}-plus"} if row["model"] == FNO else row for row in rows]
        for name, rows in CASES[claim_id][0].items()
    }
    judgement = judge(keep(tmp_path, tables), claim_id)
    assert judgement.verdict in (UNMEASURED, IN_PART)
    assert any(s.verdict == UNMEASURED and FNO in s.figure for s in judgement.ours)


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
    reaching = ratio(Figure.of(1.0, -0.5, 2.5), some)
    assert reaching.low == 0.0 and reaching.value == 0.5
    with pytest.raises(ValueError, match="means nothing"):
        ratio(Figure.of(-1.0), some)


def test_power_law_and_mean():
    times_ = [Figure.of(3.0 * n**0.7) for n in (8, 4, 2, 1)]
    assert power_law((8, 4, 2, 1), times_).value == pytest.approx(0.7)
    wide = [Figure.of(f.value, 0.9 * f.value, 1.1 * f.value) for f in times_]
    fitted = power_law((8, 4, 2, 1), wide)
    assert fitted.low < 0.7 < fitted.high and fitted.high - fitted.low < 0.4
    assert mean_figure([Figure.of(2.0), Figure.of(8.0)]).value == pytest.approx(4.0)


def test_figures_refuse_what_is_no_interval():
    assert Figure.of(2.0) == Figure(2.0, 2.0, 2.0)
    for broken in ((float("nan"),), (1.0, 1.5, 2.0), (float("inf"),)):
        with pytest.raises(ValueError, match="low <= value <= high"):
            Figure.of(*broken)


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
    row = claims.ledger([both]).iloc[0]
    assert row["dataset"] == "bandai; synthetic (procedural, no real motion)"
    assert "bandai/gpu" in row["record"] and "synthetic/laptop" in row["record"]


def test_only_times_fill_gaps(tmp_path):
    """What another data set says of quality is not taken."""
    settings = ("F3AMD-FNO-96", 13.0), ("F3AMD-FNO-96", 2.0, 1)
    keep(tmp_path, {"synthesis_time": times("GPU", [1024], *settings)}, profile="gpu")
    judged = claims.load_claims()["E7"].judge(recorded_evidence(tmp_path, "bandai", "gpu"))
    measured = next(s for s in judged if s.verdict != UNMEASURED)
    gap = next(s for s in judged if s.verdict == UNMEASURED)
    of_quality = dataclasses.replace(measured, sources=(claims.Source("synthetic/laptop/records/quality.csv", "", ""),))
    assert claims._filled([gap], {"synthetic": [measured]}) == ((measured,), ("synthetic",))
    assert claims._filled([gap], {"synthetic": [of_quality]}) == ((gap,), ())
    assert claims._filled([measured], {"synthetic": [gap]}) == ((measured,), ())


@pytest.mark.parametrize(
    ("parts", "verdict"),
    [
        ([HOLDS, HOLDS, REMARK], HOLDS),
        ([HOLDS, FAILS], IN_PART),
        ([HOLDS, UNMEASURED], IN_PART),
        ([HOLDS, OPEN], IN_PART),
        ([IN_PART], IN_PART),
        ([LARGER, OPEN, UNMEASURED], LARGER),
        ([HOLDS, LARGER], IN_PART),
        ([LARGER, FAILS], FAILS),
        ([LARGER, UNJUDGED], UNJUDGED),
        ([HOLDS, LARGER, UNJUDGED], IN_PART),
        ([UNJUDGED, UNMEASURED, REMARK], UNJUDGED),
        ([HOLDS, UNJUDGED], IN_PART),
        ([FAILS, OPEN, UNMEASURED], FAILS),
        ([OPEN, UNMEASURED], OPEN),
        ([UNMEASURED, REMARK], UNMEASURED),
        ([], UNMEASURED),
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
        ([HOLDS] + [LARGER] * 2 + [FAILS] * 2, FAILS),
        ([OPEN], OPEN),
        ([LARGER], LARGER),
    ],
)
def test_a_statement_on_many_figures_goes_by_the_majority(figures, verdict):
    assert majority(figures) == majority(reversed(figures)) == verdict


@pytest.mark.parametrize("claim_id", ["Q3", "Q8", "Q13"])
def test_a_difference_inside_its_interval_cannot_be_told_apart(tmp_path, claim_id):
    rows = [{**row, "low": 0.3 * row["value"], "high": 1.7 * row["value"]} for row in CASES[claim_id][0]["quality"]]
    assert judge(keep(tmp_path, {"quality": rows}), claim_id).verdict == OPEN


@pytest.mark.parametrize(
    ("claim_id", "tables"),
    [
        ("E1", synthesis(times("GPU", (1024,), (CAMDM, 5000.0), (FNO, 100.0)))),
        ("E2", synthesis(times("GPU", (1024,), (CAMDM, 900.0), (T64, 100.0)))),
        ("E3", synthesis(times("GPU", (1024,), (CAMDM, 900, 8, 64), (FNO, 100, 8, 64), (T64, 100, 8, 64)))),
        ("E4", small_against_many(20.0, 20.0, 20.0)),
        ("E8", synthesis(times("CPU", CPU_COUNTS, (CAMDM, 900.0), (FNO, 10.0, 1)))),
    ],
)
def test_a_gain_far_above_the_stated_range_is_another_number(tmp_path, claim_id, tables):
    judgement = judge(keep(tmp_path, tables), claim_id)
    assert judgement.verdict == LARGER, judgement.ours
    judgement = judge(keep(tmp_path / "b", conditioning(4.0, 1.32, 1.09)), "E10")
    assert [s.verdict for s in judgement.ours] == [LARGER, HOLDS, HOLDS] and judgement.verdict == IN_PART


# --------------------------------------------------------------------------------------------- the gate

SOUND = CASES["Q13"][0]
PAIR = [(FNO, 32), (f"{FNO}-no-IRD", 32)]


@pytest.mark.parametrize(
    ("gate", "reason"),
    [
        (trained(PAIR, windows=192_000), "trained 0.096 % of the paper's windows"),
        (trained(PAIR, fall=0.2), "held-out loss was still falling"),
        (trained(PAIR, slide_speed=80.0), "does not walk"),
        (trained(PAIR, stepping_rate=0.2), "does not walk"),
        (trained(PAIR, joint_acceleration=5.0), "does not walk"),
        (trained(PAIR) | {"trained": trained(PAIR[:1])["trained"]}, "no record of training"),
        (trained(PAIR) | {"walking": trained(PAIR[:1])["walking"]}, "no record of walking"),
    ],
)
def test_a_network_that_fails_the_gate_decides_nothing(tmp_path, gate, reason):
    judgement = judge(keep(tmp_path, SOUND | gate), "Q13")
    assert judgement.verdict == UNJUDGED and judgement.dataset == "bandai"
    row = claims.ledger([judgement]).iloc[0]
    assert row["ours"].startswith(f"{reason}; ○ 4 (3.96 to 4.04) against 2")
    assert reason in claims.statement_table(judgement).loc[0, "ours"]
    assert judge(keep(tmp_path / "sound", SOUND), "Q13").verdict == HOLDS


def test_the_gate_asks_what_a_claim_needs(tmp_path):
    """A network that the claim calls poor need not walk; times and a paper's own tables need no training."""
    models = [(FNO, 32), ("CAMDM-96", 32)]
    poor = trained(models)["walking"]
    poor = [row | {"slide_speed": 90.0} if row["model"] == "CAMDM-96" else row for row in poor]
    assert judge(keep(tmp_path, CASES["Q12"][0] | {"walking": poor}), "Q12").verdict == HOLDS
    short = trained(models, windows=192_000)
    assert judge(keep(tmp_path / "short", CASES["Q12"][0] | short), "Q12").verdict == UNJUDGED
    assert claims.load_claims()["Q12"].judge(paper_evidence())[0].verdict == HOLDS
    assert judge(keep(tmp_path / "time", CASES["E2"][0]), "E2").verdict == HOLDS


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
    assert judgement.verdict == UNJUDGED and judgement.ours[0].figure == "alike in 9 of 9"
    assert "trained 0.1 % of the paper's windows" in judgement.ours[0].reasons
    assert "at 200,000 windows, one training a network" in str(judgement.ours[0].sources[0])
    # As the whole ledger has it.
    assert judgement == next(each for each in claims.judge_claims(tmp_path) if each.claim.id == "Q10")
    # Seeds are averaged, and two that differ have a wide interval.
    seeds = snapshots(tmp_path / "seeds", [*alike, (FNO, 200_000, "paper", 1, "one", 1.2)])
    assert f"FID 1.1x ({FNO} over" in seeds.ours[0].figure
    assert "1 to 2 trainings a network" in str(seeds.ours[0].sources[0])
    # Nonsense: one of them is twice as bad, or one of them is missing at this length.
    apart = [*alike[:3], (models[3], 200_000, "paper", 0, "one", 2.0)]
    assert snapshots(tmp_path / "apart", apart).ours[0].figure.startswith("alike in 0 of 9")
    missing = [*alike[:3], (models[3], 400_000, "paper", 0, "one", 1.0)]
    assert snapshots(tmp_path / "missing", missing).verdict == UNMEASURED
    # A seed or a network that another classifier saw counts as any other (`records/classifiers.csv`).
    walks_worse = snapshots(tmp_path / "pooled", [*alike, (FNO, 200_000, "paper", 2, "another", (1.0, 9.0))])
    assert walks_worse.ours[0].figure.startswith("alike in 3 of 9")
    halves = [*alike[:2], *((model, 200_000, "paper", 0, "other", 1.0) for model in models[2:])]
    assert snapshots(tmp_path / "halves", halves).ours[0].figure == "alike in 9 of 9"
    # The longest of the lengths that have all of them decides.
    longer = [(model, 800_000, "paper", 0, "one", 2.0) for model in models]
    twice = snapshots(tmp_path / "twice", [*alike, *longer])
    assert twice.ours[0].figure == "alike in 9 of 9" and "at 800,000 windows" in str(twice.ours[0].sources[0])


def test_snapshots_of_the_queue_are_learning_curves(tmp_path):
    """E13 asks in which epoch a network comes close to its best."""
    lengths = (100_000, 200_000, 400_000, 800_000)

    def curve(model, worths, recipe="paper", seed=0, classifier="one"):
        """What the classifier sees stays; the other metrics are better when they are lower."""
        return [
            (model, length, recipe, seed, classifier, (1.0, worth))
            for length, worth in zip(lengths, worths, strict=True)
        ]

    soon, late, falling = (9.0, 1.0, 1.0, 1.0), (9.0, 5.0, 1.0, 1.0), (9.0, 5.0, 3.0, 1.0)
    judged = lambda name, *curves: snapshots(tmp_path / name, sum(curves, []), "E13")
    fast, slow = curve(FNO, soon), curve(CAMDM, late)
    holds = judged("holds", fast, slow)
    assert holds.verdict == HOLDS and "foot_sliding 2 against 4" in holds.ours[0].figure
    assert judged("fails", curve(FNO, late), curve(CAMDM, soon)).verdict == FAILS
    unfinished = judged("falling", fast, curve(CAMDM, falling))
    assert unfinished.verdict == UNMEASURED and "still getting better at the last epoch, 8" in unfinished.ours[0].figure
    # Another recipe or a single length is no curve beside this one; one that another classifier saw is.
    for name, other in {"recipe": curve(CAMDM, late, recipe="wide-decoder"), "single": slow[:1]}.items():
        assert "quality_by_epoch.csv has no " in judged(name, fast, other).ours[0].figure, name
    assert judged("classifier", fast, curve(CAMDM, late, classifier="another")).verdict == HOLDS
    # Of two seeds the curve of more snapshots decides.
    assert judged("seeds", fast, slow, curve(FNO, late, seed=1)[:2]).verdict == HOLDS


@pytest.mark.parametrize(("skates", "verdict"), [((FNO, 64), UNJUDGED), ((CAMDM, 64), HOLDS), ((CAMDM, 32), UNJUDGED)])
def test_a_network_has_to_walk_with_the_window_that_it_is_judged_with(tmp_path, skates, verdict):
    """Q4 says that CAMDM fails with 64 frames, and so that one need not walk."""
    walking = trained([(name, window) for name in (FNO, CAMDM) for window in (32, 64)])["walking"]
    walking = [
        row | {"slide_speed": 90.0} if (row["model"], row["window_frames"]) == skates else row for row in walking
    ]
    statements = [s for s in judge(keep(tmp_path, CASES["Q4"][0] | {"walking": walking}), "Q4").ours if s.verdict]
    about = statements[skates[0] == CAMDM]
    assert about.verdict == verdict and (skates[0] in about.reasons.get("does not walk", ())) == (verdict == UNJUDGED)


def test_a_judged_data_set_decides_before_one_that_only_has_figures(tmp_path):
    keep(tmp_path, SOUND | trained(PAIR, windows=192_000), dataset="bandai")
    keep(tmp_path, SOUND, dataset="synthetic")
    judgement = judge(tmp_path, "Q13")
    assert (judgement.verdict, judgement.dataset) == (HOLDS, "synthetic")


# ---------------------------------------------------------------------------- intervals of times


def test_the_interval_of_a_median_is_not_the_spread_of_its_rounds(tmp_path):
    """Both forms: the bootstrap of new records, and what older ones have, which comes close to it."""
    rounds = np.random.default_rng(1).lognormal(4.0, 0.3, 100)
    value, low, high = np.quantile(rounds, (0.5, 0.05, 0.95))
    bootstrap = median_interval(rounds)
    assert low < bootstrap[0] < value < bootstrap[1] < high
    (row,) = times("CPU", (1,), (FNO, float(value)))
    row |= {"low": low, "high": high, "rounds": 100}
    columns = {"median_low": bootstrap[0], "median_high": bootstrap[1]}
    figures = [
        recorded_evidence(keep(tmp_path / str(k), {"synthesis_time": [one]}), "bandai", "laptop").time(
            Setting(FNO), "CPU", 1
        )
        for k, one in enumerate((row | columns, row))
    ]
    assert (figures[0].low, figures[0].high) == pytest.approx(bootstrap)
    widths_ = [figure.high - figure.low for figure in figures]
    assert 0.6 < widths_[1] / widths_[0] < 1.7


def test_the_interval_of_a_median_holds_it_19_times_of_20():
    draw = np.random.default_rng(2).exponential
    inside = [low <= np.log(2.0) <= high for low, high in (median_interval(draw(1.0, 50), 400) for _ in range(300))]
    assert 0.9 < np.mean(inside) < 0.99


def test_a_slower_network_on_many_rounds_is_told_apart(tmp_path):
    """Wide rounds, narrow medians: slower by 15 % is a clear no where 100 rounds were timed."""
    tables = {"synthesis_time": [row | {"rounds": 100} for row in crowds(115.0, 100.0)["synthesis_time"]]}
    for row in tables["synthesis_time"]:
        row |= {"low": 0.75 * row["value"], "high": 1.3 * row["value"]}
    assert judge(keep(tmp_path, tables), "E5").verdict == FAILS
    for row in tables["synthesis_time"]:
        del row["rounds"]
    assert judge(keep(tmp_path / "spread", tables), "E5").verdict == OPEN


# ------------------------------------------------------------------------------- other convictions


def test_both_compilers_are_judged_and_named(tmp_path):
    """E11: the paper's JAX is IREE, and XLA may say something else."""
    rows = times("CPU", CPU_COUNTS, (CAMDM, 110.0), (CAMDM, 100.0, 8, 32, "torch"))
    rows += times("CPU", (32,), (CAMDM, 250.0, 8, 32, "iree"))
    judgement = judge(keep(tmp_path, {"synthesis_time": rows}), "E11")
    found = {s.says.split(",")[0]: (s.verdict, s.figure) for s in judgement.ours if "2 to 5" in s.says}
    assert found["IREE"][0] == HOLDS and found["IREE"][1].endswith("at 32")
    assert found["IREE"][1].startswith("JAX by IREE / ") and found["XLA"][1].startswith("JAX by XLA / ")
    assert found["XLA"][0] == FAILS and judgement.verdict == IN_PART


def test_excess_stands_beside_literal_ird(tmp_path):
    """A seam at which the character sticks has the lower IRD and the higher excess."""
    excess = [
        {**row, "metric": "IRD_excess", "value": value, "low": value, "high": value}
        for model, value in ((FNO, 7.0), (CAMDM, 5.0))
        for row in quality(model)
        if row["metric"] == "IRD"
    ]
    tables = qualities(quality(FNO), quality(T64), quality(CAMDM, FID=8.0, IRD=4.0), excess)
    judgement = judge(keep(tmp_path, tables), "Q3")
    shown = {s.says: s.figure for s in judgement.ours}
    assert judgement.verdict == HOLDS and shown["IRD_excess of CAMDM against FNO-96"] == "5 against 7 cm"
    for claim_id in ("Q2", "Q3", "Q13"):
        assert any("IRD_excess" in statement.says for statement in claims.load_claims()[claim_id].statements)


def test_a_run_that_still_gets_better_tells_nothing_of_convergence(tmp_path):
    judgement = judge(keep(tmp_path, epochs(fno=30, camdm=99)), "E13")
    assert judgement.verdict == UNMEASURED
    assert "CAMDM was still getting better at the last epoch, 100" in judgement.ours[0].figure


# ------------------------------------------------------------------------- whose records decide


def test_gpu_claims_are_decided_by_gpu_rows(tmp_path):
    root = keep(tmp_path, {"synthesis_time": times("CPU", (1024,), (CAMDM, 300.0), (T64, 100.0))})
    judgement = judge(root, "E2")
    assert judgement.verdict == UNMEASURED
    assert judgement.ours[0].figure == "synthesis_time.csv has no rows of a GPU"


def test_one_claim_may_rest_on_a_gpu_run_and_a_laptop_run(tmp_path):
    rows = crowds(85.0, 100.0)["synthesis_time"]
    for device, profile in (("GPU", "gpu"), ("CPU", "laptop")):
        mine = [row for row in rows if row["device"] == device]
        platform = {"device_platform": "cpu", "device_kind": "cpu"} if device == "CPU" else {}
        keep(tmp_path, {"synthesis_time": mine}, profile=profile, **platform)
    judgement = judge(tmp_path, "E5")
    assert judgement.verdict == HOLDS
    row = claims.ledger([judgement]).iloc[0]
    assert row["hardware"] == "Test GPU; CPU, 2 cores"
    assert row["record"].startswith("bandai/gpu/records/synthesis_time.csv (")
    assert "bandai/laptop/records/synthesis_time.csv (" in row["record"]


def test_real_motion_decides_before_synthetic(tmp_path):
    holds, fails = CASES["Q13"]
    keep(tmp_path, holds, dataset="synthetic")
    judgement = judge(tmp_path, "Q13")
    assert judgement.verdict == HOLDS
    labelled = claims.ledger([judgement]).iloc[0]["dataset"]
    assert labelled == "synthetic (procedural, no real motion)"
    keep(tmp_path, fails, dataset="bandai")
    assert judge(tmp_path, "Q13").verdict == FAILS
    assert judge(tmp_path, "Q13", datasets=("synthetic",)).verdict == HOLDS


def test_the_reason_is_the_row_that_is_missing(tmp_path):
    keep(tmp_path, qualities(quality(FNO)), dataset="synthetic")
    judgement = judge(tmp_path, "Q13")
    wanted = "quality.csv has no F3AMD-FNO-96-no-IRD, 32 frames, 8 steps, IRD"
    assert judgement.ours[0].figure == wanted
    assert claims.ledger([judgement]).iloc[0]["ours"] == wanted


def test_undefined_figures_are_not_measured(tmp_path):
    rows = CASES["Q13"][0]["quality"]
    rows = [{**row, "value": float("nan")} if row["metric"] == "IRD" else row for row in rows]
    assert judge(keep(tmp_path, {"quality": rows}), "Q13").verdict == UNMEASURED


GOOD = CASES["Q13"][0]["quality"]
ON_GPU = times("GPU", (1024,), (CAMDM, 300.0), (T64, 100.0))


@pytest.mark.parametrize(
    ("claim_id", "tables", "changes", "message"),
    [
        ("Q13", {"quality": GOOD + GOOD[:1]}, {}, "two rows of"),
        ("Q13", {"quality": [{**GOOD[0], "model": "FNO-96"}]}, {}, "unknown model 'FNO-96'"),
        ("Q13", {"quality": [{**GOOD[3], "unit": "cm"}]}, {}, "another unit than the paper of .*trajectory_error"),
        ("Q13", {"quality": [{"model": FNO, "value": 1.0}]}, {}, "needs a column 'window_frames'"),
        ("E2", {"synthesis_time": ON_GPU}, {"device_platform": "cpu"}, "knows only a CPU"),
        ("E2", {"synthesis_time": [{**ON_GPU[0], "device": "gpu"}]}, {}, "device must be CPU or GPU"),
        ("Q13", {"quality": [{**GOOD[-1], "low": 9.0}]}, {}, "outside its interval"),
    ],
)
def test_a_broken_table_is_an_error(tmp_path, claim_id, tables, changes, message):
    keep(tmp_path, tables, **changes)
    with pytest.raises(ValueError, match=message):
        judge(tmp_path, claim_id)


def test_a_foreign_or_lost_record_is_an_error(tmp_path):
    keep(tmp_path, CASES["Q13"][0], dataset="synthetic")
    (tmp_path / "synthetic").rename(tmp_path / "bandai")
    with pytest.raises(ValueError, match="record of dataset 'synthetic', yet lies among"):
        judge(tmp_path, "Q13")
    record = tmp_path / "bandai" / "laptop" / "records" / "quality.json"
    text = record.read_text()
    record.unlink()
    with pytest.raises(ValueError, match="has no run record"):
        judge(tmp_path, "Q13")
    record.write_text(text)
    table = record.with_suffix(".csv")
    table.write_text(table.read_text().replace("4.0", "0.4"))
    with pytest.raises(ValueError, match="not the table that"):
        judge(tmp_path, "Q13")


def test_unknown_names_and_smoke_runs_are_refused(tmp_path):
    with pytest.raises(ValueError, match="unknown profile 'smoke'"):
        claims.judge_claims(tmp_path, profile="smoke")
    with pytest.raises(ValueError, match="unknown data set 'bandi'; did you mean 'bandai'"):
        claims.judge_claims(tmp_path, dataset="bandi")


# ------------------------------------------------------------------------------ the file of claims

STATEMENT = {"says": "FNO is worse", "kind": "worse", "model": FNO, "against": CAMDM, "metric": "FID"}
FILE = {
    "groups": {"Q": "Quality"},
    "thresholds": {"minor": 1.3},
    "families": {"FNO": {"models": [FNO, "F3AMD-FNO-64"], "required": [FNO]}},
}
SPREAD = {"says": "alike", "kind": "metric_spread", "metric": "FID", "within": [0, "minor"]}


def read(*statements, ids=("Q1",)):
    entry = {"text": "worse", "where": "1", "decided_by": "FID", "statement": list(statements)}
    return claims.read_claims(FILE | {"claim": [{"id": name, **entry} for name in ids]}, "f3amd", "f.toml")


def test_a_statement_names_its_kind_models_and_range():
    claim = read(STATEMENT | {"about": [5, 2]}, SPREAD | {"models": {"family": "FNO", "window": 64}})["Q1"]
    first, second = (statement.rule.keywords for statement in claim.statements)
    assert first["model"] == Setting(FNO) and first["bounds"] == pytest.approx((2.25, 2.75))
    assert second["bounds"] == (0, 1.3) and second["models"].required == (Setting(FNO, window=64),)


@pytest.mark.parametrize(
    ("statement", "message"),
    [
        ({key: STATEMENT[key] for key in STATEMENT if key != "kind"}, "has no 'kind'; add it"),
        (STATEMENT | {"kind": "wors"}, "unknown kind of judgement 'wors'; did you mean 'worse'"),
        (STATEMENT | {"model": "FNO-96"}, "unknown model 'FNO-96'"),
        (STATEMENT | {"model": {"model": FNO, "step": 1}}, "unknown key 'step'; did you mean 'steps'"),
        (STATEMENT | {"within": [0, 1], "alike": 0.1}, "has the ranges within and alike; keep one"),
        (STATEMENT | {"stated": [2]}, "stated: .2. is another number of numbers"),
        (STATEMENT | {"about": [5, 2, 1]}, "about: .5, 2, 1. is another number of numbers"),
        (STATEMENT | {"within": [0, "miner"]}, "unknown threshold 'miner'; did you mean 'minor'"),
        (STATEMENT | {"metric": "FD"}, "unknown metric 'FD'; did you mean 'FID'"),
        (STATEMENT | {"kind": "ranked", "table": "qualty"}, "unknown table 'qualty'; did you mean 'quality'"),
        (STATEMENT | {"device": "GPU"}, "unexpected keyword argument 'device'; worse takes"),
        ({key: STATEMENT[key] for key in STATEMENT if key != "metric"}, "missing a required argument: 'metric'"),
        (SPREAD | {"models": {"family": "FN"}}, "unknown family 'FN'"),
    ],
)
def test_a_broken_statement_is_an_error(statement, message):
    with pytest.raises(ValueError, match=f"f.toml, claim Q1, '{statement['says']}': .*{message}"):
        read(statement)


def test_what_a_page_says_under_an_unknown_name_is_refused():
    with pytest.raises(ValueError, match="f.toml, page: unknown key 'prefaces'; did you mean 'preface'"):
        claims.read_claims(FILE | {"page": {"prefaces": "-"}, "claim": []}, "f3amd", "f.toml")


def test_an_id_is_used_once_and_begins_with_a_group():
    for ids in (("Q1", "Q1"), ("X1",)):
        with pytest.raises(ValueError, match="id of its own that begins with one of Q"):
            read(STATEMENT, ids=ids)


# ----------------------------------------------------------------------- the paper's own tables


def paper_figures(claim_id):
    """Verdict and all figures of a claim, from the paper's tables."""
    statements = claims.load_claims()[claim_id].judge(paper_evidence())
    judged = [s for s in statements if not (s.optional and s.verdict == UNMEASURED)]
    return combine(s.verdict for s in judged), {s.says: s.figure for s in judged}


# Claim -> verdict and figures that the paper's own tables give.
PAPERS_OWN = {
    "E1": (HOLDS, {"GPU, 16 characters": "1.39 to 1.88x", "GPU, FNO-96 with 8 steps": "above 4 at 128, 256, 1,024"}),
    "E4": (
        IN_PART,
        {
            "CPU, FNO-96 at 4 to 8": "4.43 to 4.71x",
            "CPU, FNO-96 at 16 to 32": "2.76 to 4.04x",
            "CPU, 1 to 32 characters: Transformer 2 to 3 times": "1.71 to 6.57x, 10 of 30 in the range",
        },
    ),
    "E5": (
        HOLDS,
        {
            "GPU, 128 to 1,024 characters: 10 to 22 % less time": "9.28 to 20.8 %",
            "CPU, 16 to 32 characters: 10 to 22 % less time": "9.68 to 22.8 %",
        },
    ),
    "E7": (IN_PART, {"CPU, 32 characters: about 3.4 times": "3.76x"}),
    "E8": (HOLDS, {"CPU, 1 to 32 characters: 10 to 20 times": "9.77 to 21x"}),
    "E11": (
        IN_PART,
        {
            "IREE, CPU, 32 characters": "JAX by IREE / PyTorch 1.8",
            "IREE, GPU, 1 to 16 characters: alike within a fifth": "JAX by IREE / PyTorch 0.346 to 0.717, "
            "0 of 5 in the range",
        },
    ),
    "E12": (
        IN_PART,
        {
            "GPU, FNO-96 with 1 step": "above 20 at 256, 512, 1,024",
            "CPU, FNO-96 with 1 step": "above 20 at 8",
            "CPU, 32 characters: over 20 times": "10.4x",
            "CPU, F3AMD-FNO-96 (1 step) against CAMDM in PyTorch": "3.63 to 5.77x",
            "CPU, F3AMD-FNO-96 (8 steps) against CAMDM in PyTorch": "0.639 to 1.53x, slower at 1, 2, 4",
        },
    ),
    "E15": (IN_PART, {"CPU, 8 -> 1 steps": "6.44x at 1 and 3.76x at 32"}),
    "Q2": (
        IN_PART,
        {
            "32 frames: FNO has the better IRD": "yes at D = 32, 48, 96, 128, no at D = 64",
            "64 frames: FNO has the better IRD": "yes at D = 64, no at D = 96, 128",
        },
    ),
    "Q4": (FAILS, {"IRD is lower with 64 frames": "in 4 of 6 models"}),
    "Q5": (
        HOLDS,
        {
            "FNO-96 at 4, 2 and 1 steps: every metric within 10 % of 8 steps": "9 of 9 metrics; "
            "largest change: IRD -3.68 % at 2 steps",
            "largest change from one number of steps to the next": "8 to 4 0.056 %, 4 to 2 3.6 %, 2 to 1 0.058 %",
        },
    ),
    "Q9": (
        IN_PART,
        {"m = 1 is worse than m = 17, metric by metric": "worse in 6 of 9, better in EMD, direction_error, smoothness"},
    ),
    "Q11": (IN_PART, {"FiLM is last of the four in": "FID, EMD, style_coverage, trajectory_error"}),
    "Q13": (UNMEASURED, {}),
    "Q17": (HOLDS, {}),
}


@pytest.mark.parametrize("claim_id", PAPERS_OWN)
def test_what_the_papers_own_tables_say(claim_id):
    verdict, figures = PAPERS_OWN[claim_id]
    found_verdict, found = paper_figures(claim_id)
    assert found_verdict == verdict
    assert {says: found[says] for says in figures} == figures


@pytest.mark.parametrize(
    ("claim_id", "parts"),
    [
        ("E5", ["9.28", "22.8 %"]),
        ("Q4", ["trajectory_error 18x (F3AMD-FNO-64)", "FID +60.5 % (F3AMD-Transformer-64)"]),
        ("Q9", ["trajectory_error 3.43x"]),
        ("Q10", ["IRD 2.05x (F3AMD-DCT-96 over F3AMD-reduced-rank-FNO-96)"]),
    ],
)
def test_outliers_in_the_papers_own_tables(claim_id, parts):
    told = " ".join(paper_figures(claim_id)[1].values())
    assert [part for part in parts if part not in told] == []


def test_the_paper_is_read_like_our_records():
    paper = paper_evidence()
    assert paper.time(Setting(CAMDM), "GPU", 16).value == 8.95
    assert paper.time(Setting("CAMDM-code"), "CPU", 1, "torch").value == 34.58
    assert paper.time(Setting(f"{FNO}-concatenation"), "GPU", 1024).value == 183.39
    assert paper.quality(Setting(f"{FNO}-m14"), "IRD").value == 3.131
    row = {"model": FNO, "window_frames": 64, "batch_size": 512}
    assert paper.figure("training_time", **row, device="GPU").value == 6.48
    with pytest.raises(NotMeasured, match="the paper prints no CAMDM, 64 frames, 8 steps, FID"):
        paper.quality(Setting(CAMDM, window=64), "FID")


@pytest.mark.parametrize(
    ("record", "message"),
    [
        ("", "tiny/paper.toml: table 1: t.csv has no window_frames, as rows of 'quality' have .* `record` of its own"),
        ('record = "qualty"', "tiny/paper.toml: table 1 .*unknown record 'qualty'; did you mean 'quality'"),
    ],
)
def test_a_table_of_a_new_paper_that_fits_no_record_is_refused_by_name(tmp_path, monkeypatch, record, message):
    folder = tmp_path / "tiny"
    (folder / "numbers").mkdir(parents=True)
    table = f'[[table]]\nnumber = "1"\nfile = "t.csv"\ntitle = "FID"\n{record}\n'
    (folder / "paper.toml").write_text(f'name = "TINY"\nsetting = "paper"\n{table}')
    (folder / "numbers" / "t.csv").write_text(f"model,steps,metric,unit,better,value\n{FNO},8,FID,,down,1.0\n")
    monkeypatch.setattr(papers, "_FOLDER", tmp_path)
    papers.load_paper_file.cache_clear()
    with pytest.raises(ValueError, match=message):
        paper_evidence("tiny")
    papers.load_paper_file.cache_clear()


# ------------------------------------------------------------------------------ computed claims


def test_computed_claims_need_no_records(tmp_path):
    """VE is VP; the update holds with rescaling only; convolutions are left out of the cost."""
    t1, t2, t3 = (judge(tmp_path, name) for name in ("T1", "T2", "T3"))
    assert t1.verdict == HOLDS and t2.verdict == t3.verdict == IN_PART
    assert [s.verdict for s in t2.ours] == [HOLDS, HOLDS, FAILS]
    assert "mean |x| 0.000" in t2.ours[2].figure
    assert [s.verdict for s in t3.ours] == [HOLDS, HOLDS, FAILS]
    assert t3.ours[0].figure == "24 T D² + 4 T² D operations"
    assert "2.82 times the spectral product" in t3.ours[2].figure
    assert claims.ledger([t1]).iloc[0]["dataset"] == "computed"


# ---------------------------------------------------------------------------- the ledger itself


@pytest.fixture(scope="module")
def committed():
    """Judgements from the committed records."""
    return claims.judge_claims()


def test_the_verdicts_are_the_accepted_ones(committed):
    changes = claims.changed_verdicts(claims.ledger(committed), claims.accepted_verdicts())
    assert not changes, (
        "\n".join(changes) + "\nIf these are right, accept on purpose with "
        "`python -m f3amd_companion.ledger.claims --accept`"
    )


def test_the_committed_page_is_up_to_date(committed):
    page = claims.repository_root() / "paper_figures" / "claims.md"
    assert page.read_text(encoding="utf-8") == claims.ledger_markdown(committed), (
        "paper_figures/claims.md is stale: run `python -m f3amd_companion.ledger.claims`"
    )


LEDGER_TABLES = sorted((claims.repository_root() / "paper_figures").glob("*/*/tables/08_claims.csv"))


@pytest.mark.parametrize("path", LEDGER_TABLES, ids=lambda path: path.parts[-4])
def test_the_ledger_among_a_data_sets_tables_is_the_accepted_one(path):
    """Notebook 08 leaves it there, whatever data it was run on."""
    table = read_table(path)[0].set_index("id")["verdict"]
    accepted = {claim_id: entry["verdict"] for claim_id, entry in claims.accepted_verdicts().items()}
    assert table.to_dict() == accepted, f"run notebook 08 again: f3amd figures --data {path.parts[-4]} --only 08"


def test_the_ledger_has_all_claims(committed):
    frame = claims.ledger(committed)
    ids = [f"E{i}" for i in range(1, 19)] + [f"Q{i}" for i in range(1, 20)]
    assert frame["id"].tolist() == [*ids, *(f"T{i}" for i in range(1, 7))]
    assert set(frame["verdict"]) | set(frame["paper_verdict"]) <= set(VERDICTS)
    assert (frame[["claim", "where", "decided_by", "ours"]] != "").all(axis=None)
    measured = frame[frame["verdict"] != UNMEASURED]
    assert (measured[["dataset", "hardware"]] != "").all(axis=None)
    assert (measured.loc[measured["dataset"] != "computed", "record"] != "").all()


def test_a_changed_verdict_is_noticed_until_it_is_accepted(tmp_path):
    holds, fails = ([judge(keep(tmp_path / str(i), CASES["Q13"][i]), "Q13")] for i in (0, 1))
    path = tmp_path / "claims.md"
    assert claims.write_ledger(path, holds) and not path.exists()
    claims.write_ledger(path, holds, accept=True)
    page, verdicts = path.read_text(), path.with_suffix(".json").read_text()
    assert claims.write_ledger(path, holds) == []
    (change,) = claims.write_ledger(path, fails)
    assert change.startswith("Q13 by our records: was 'holds', is 'does not hold' (")
    assert path.read_text() == page and path.with_suffix(".json").read_text() == verdicts
    claims.write_ledger(path, fails, accept=True)
    assert claims.accepted_verdicts(path)["Q13"]["verdict"] == FAILS
    assert claims.write_ledger(path, fails) == []
    with pytest.raises(ValueError, match="ledgers are written as .md"):
        claims.write_ledger(tmp_path / "claims.csv", fails)


def test_the_command_tells_by_its_status(tmp_path, monkeypatch, caplog):
    caplog.set_level("INFO", logger="f3amd")
    monkeypatch.setattr(claims, "repository_root", lambda: tmp_path)
    only = {"Q13": claims.load_claims()["Q13"]}
    monkeypatch.setattr(claims, "load_claims", lambda paper: only)
    results = keep(tmp_path / "paper_figures", CASES["Q13"][0])
    assert claims.main() == 1 and "Nothing was written" in caplog.text
    assert claims.main(accept=True) == 0 and claims.main() == 0
    assert "Q13 by our records" in caplog.text
    assert (results / "claims.md").read_text().count("| Q13 |") == 1
    (results / "bandai" / "laptop" / "records" / "quality.json").unlink()
    assert claims.main() == 2


def test_markdown_shows_verdict_figure_and_record(tmp_path):
    judgement = judge(keep(tmp_path, CASES["Q13"][0]), "Q13")
    text = claims.ledger_markdown([judgement])
    (row,) = [line for line in text.splitlines() if line.startswith("| Q13 |")]
    assert "holds: ✓ 4 (3.96 to 4.04) against 2 (1.98 to 2.02) cm" in row
    assert "| no figures | bandai | Test GPU | bandai/laptop/records/quality.csv (" in row
    table = claims.statement_table(judgement)
    assert table.columns.tolist() == ["statement", "ours", "the paper's tables"]
    assert table.loc[0, "ours"].endswith("· holds")
    assert table.loc[0, "the paper's tables"].startswith("not measured (the paper prints no")
