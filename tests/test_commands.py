"""The command that measures each claim: it asks for all that the claim's rule looks up, and it runs at smoke size."""

import dataclasses
import itertools
import re
import shlex

import claims_page
import pandas as pd
import pytest
from builders import load_commands

from f3amd_companion.__main__ import main
from f3amd_companion.ledger import claims
from f3amd_companion.ledger.evidence import NINE_METRICS, recorded_evidence, snapshot_evidence
from f3amd_companion.ledger.judgements import UNMEASURED
from f3amd_companion.measuring import campaign, measure, sensitivity
from f3amd_companion.measuring import times as measurements
from f3amd_companion.measuring.sensitivity import FOOT_BANDS, STRENGTHS
from f3amd_companion.measuring.text_tables import TABLES, TEXT_MEASUREMENTS
from f3amd_companion.speed import implementations
from f3amd_lib.ground.names import nearest_hint
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import write_table
from f3amd_lib.measures import protocol
from f3amd_lib.measures.corruptions import CORRUPTIONS
from f3amd_lib.networks import presets
from f3amd_lib.papers.printed import PUBLISHED_CAMDM

COMMANDS = list(dict.fromkeys(run for runs in load_commands().values() for run in runs))


def asked(run: str):
    """Return what a command line hands over: (command, data set, profile, window, measurement or suite, models)."""
    words = shlex.split(run)
    value = lambda name, otherwise=None: words[words.index(name) + 1] if name in words else otherwise
    models = [words[place + 1] for place, word in enumerate(words) if word == "--model"]
    models += [PUBLISHED_CAMDM] if "--published" in words else []
    data, profile = value("--data", "bandai"), value("--profile", "gpu")
    window = int(value("--window", load_profile(profile, data).window))
    what = value("--suite") or ("training" if "--training" in words else words[2] if len(words) > 2 else "")
    return words[1], data, profile, window, what, models


def tables(run: str) -> dict[str, list[dict]]:
    """Return rows as the command would leave them, each with the figure 1."""
    command, _, _, window, what, models = asked(run)
    figure = {"value": 1.0, "low": 0.9, "high": 1.1}
    if command == "bench" and what == "training":
        named = {"window_frames": window, "device": "GPU", "batch_size": 512, "peak_memory_mib": 1.0}
        return {"training_time": [named | figure | {"model": model} for model in measurements._TRAINED]}
    if command == "bench":
        candidates = [candidate for group in measurements.plan(what).values() for candidate in group]
        rows = pd.DataFrame(map(dataclasses.asdict, candidates))
        rows = rows.assign(framework=rows["way"].map(lambda way: implementations.IMPLEMENTATIONS[way][0]))
        rows = rows.assign(device="GPU" if what == "gpu" else "CPU", **figure)
        keys = ["model", "window_frames", "steps", "framework", "device", "characters"]
        return {"synthesis_time": rows.drop_duplicates(keys).to_dict("records")}
    units = {metric: unit for metric, (unit, _) in NINE_METRICS.items()}
    if what == "quality":
        steps = {model: (4, 2, 1) if model == PUBLISHED_CAMDM else measure.STEPS for model in models} | {"real": (0,)}
        named = [{"model": one, "window_frames": window, "steps": n} for one, counts in steps.items() for n in counts]
        quality = [one | figure | {"metric": metric, "unit": unit} for one in named for metric, unit in units.items()]
        extra = [{**one, **figure, "metric": "IRD_excess", "unit": "cm"} for one in named]
        rounds = [
            one | {"metric": metric, "round": number, "value": 1.0}
            for one, metric, number in itertools.product(named, ("gap_m", "acceleration_cm"), range(1, 81))
        ]
        return {"quality": quality + extra, "quality_by_round": rounds}
    if command == "campaign":
        named = {"recipe": "paper", "window_frames": 32, "seed": 0, "value": 1.0, "steps": 8}
        units |= {"held_out_loss": "", "held_out_error": "cm"}
        rows = itertools.product(("F3AMD-FNO-96", "CAMDM"), range(1, 11), units.items())
        queue = [
            named | {"model": model, "run": model, "windows": n, "epochs": n, "metric": metric, "unit": unit}
            for model, n, (metric, unit) in rows
        ]
        weighted = [row | {"recipe": "low-noise-weighting"} for row in queue if row["metric"] == "held_out_error"]
        return {command: queue + weighted}
    if what == "trained":
        walks = {"stepping_rate": 1.8, "joint_acceleration": 1.0, "slide_speed": 5.0, "floor_penetration": 0.0}
        named = [{"model": model, "window_frames": window} for model in ("real", *presets.PRESETS)]
        return {
            "trained": [one | {"metric": "windows", "value": 1e9} for one in named],
            "walking": [one | {"steps": 8 * (one["model"] != "real")} | walks for one in named],
        }
    if what == "foot_spectrum":
        named = {"window_frames": window, "steps": 8, "metric": "toe_power_over_real"}
        return {what: [named | figure | {"model": model, "band": band} for model in models for band in FOOT_BANDS]}
    if what == "sensitivity":
        rows = itertools.product(CORRUPTIONS, STRENGTHS, ("FID", "EMD"))
        return {"corruptions": [figure | {"corruption": c, "strength": s, "metric": m} for c, s, m in rows]}
    if what == "noise_use":
        levels = {model: presets.find_preset(model).network.get("noise_levels") or measure.SIGMAS for model in models}
        rows = [(model, sigma) for model in models for sigma in levels[model]]
        return {"x0_by_sigma": [{"model": model, "sigma": sigma, "x0_error": 1.0} for model, sigma in rows]}
    if what == "gradient_norm":
        return {what: [figure | {"model": "F3AMD-FNO-96", "sigma": sigma} for sigma in measure.SIGMAS]}
    assert command == "scripts/claims_page.py", nearest_hint(what, measure.MEASUREMENTS)
    return {}


OUT_OF_REACH = {"E11": ("IREE, GPU", 2), "E13": ("FID: FNO-96 needs", 1)}
"""How statements begin that nothing here measures, and how many: IREE runs on a CPU alone; none follows epochs."""

OF_SEEDS = {"seen once", "not seen at half its length", "not converged: no training of twice the length agrees"}
"""What the gate asks beyond the commands: the same for other seeds and lengths."""


@pytest.mark.slow
@pytest.mark.parametrize("claim", claims.load_claims().values(), ids=lambda claim: claim.id)
def test_a_claims_commands_measure_all_that_its_rule_looks_up(claim, tmp_path):
    """All that the commands would write, and nothing else, is enough to judge every statement."""
    left: dict[tuple, list] = {}
    for run in load_commands()[claim.id]:
        _, data, profile, *_ = asked(run)
        for name, rows in tables(run).items():
            left.setdefault((data, profile, name), []).extend(rows)
    for (data, profile, name), rows in left.items():
        record = {"dataset": data, "profile": profile, "seed": 0, "device_platform": "gpu", "device_kind": "Test"}
        write_table(tmp_path / data / profile / "records" / f"{name}.csv", pd.DataFrame(rows), record)
    # Times on a GPU and on a CPU come from two data sets: statements may rest on either.
    evidences = [recorded_evidence(tmp_path, *key) for key in dict.fromkeys(key[:2] for key in left)]
    evidences += [one for key in left for one in snapshot_evidence(tmp_path, *key[:2])]
    evidences = evidences or [recorded_evidence(tmp_path, "bandai", "gpu")]
    judgement = claims.judge_claim(claim, {"bandai": evidences})
    beyond, count = OUT_OF_REACH.get(claim.id, ("-", 0))
    missing = [statement for statement in judgement.ours if statement.verdict == UNMEASURED]
    assert [one.figure for one in missing if not one.says.startswith(beyond)] == []
    assert len({one.says for one in missing}) == count
    assert {reason for one in judgement.ours for reason in one.reasons} <= OF_SEEDS


@pytest.mark.slow
def test_every_claim_has_a_command_that_the_ledger_prints():
    page = claims_page.ledger_markdown(claims.judge_claims())
    listed = {run: ids.split(", ") for ids, run in re.findall(r"^# ([\w, ]+)\n(.+)$", page, re.M)}
    for claim_id, runs in load_commands().items():
        assert all(claim_id in listed[run] for run in runs), claim_id


@pytest.mark.parametrize("run", [run for run in COMMANDS if not run.startswith("python ")])
def test_a_command_is_understood(run, monkeypatch):
    """The words reach the measurement that is meant; nothing is measured."""
    called = []
    monkeypatch.setattr("f3amd_companion.terminal.check_there", lambda *paths: None)
    monkeypatch.setattr("f3amd_lib.training.pipeline.prepare", lambda profile, **how: profile)
    for name in measure.MEASUREMENTS:
        note = lambda _, profile, models, name=name, **extra: called.append((name, profile.window, models, extra)) or ""
        monkeypatch.setitem(measure.MEASUREMENTS, name, note)
    monkeypatch.setattr(measurements, "measure_training_time", lambda _, profile, **__: called.append(profile.window))
    monkeypatch.setattr(measurements, "measure_synthesis_time", lambda *a, **k: called.append(a[2]) or 1 / 0)
    monkeypatch.setattr(measure, "protocol_of", lambda *_: (None, None, None))
    monkeypatch.setattr(campaign, "run_campaign", lambda _, profile, *a, **k: iter([called.append(profile.name)][1:]))
    command, _, _, window, what, models = asked(run)
    status = main(shlex.split(run)[1:])
    if command == "campaign":
        assert called == ["gpu"] and status == 0
    elif what == "training":
        assert called == [window] and status == 0
    elif command == "bench":
        assert called == [(what,)]
    else:
        assert [name for name, *_ in called] == (["trained", "walking"] if what == "trained" else [what])
        for _, used, given, extra in called:
            assert (used, status) == (window, 0)
            assert (given or []) + [PUBLISHED_CAMDM] * len(extra) == models


OF_TEXT = [(paper, claim_id) for paper in ("acmdm", "motionpcm") for claim_id in claims.load_claims(paper)]


def told(part, key: str) -> set[str]:
    """Return all that a claim's entry has under a key, however deep."""
    if isinstance(part, dict):
        return {part[key]} if key in part else set().union(*(told(value, key) for value in part.values()))
    return set().union(*(told(value, key) for value in part)) if isinstance(part, list) else set()


@pytest.mark.slow
@pytest.mark.parametrize(("paper", "claim_id"), OF_TEXT)
def test_a_command_of_text_to_motion_reaches_what_its_claim_is_about(paper, claim_id, monkeypatch):
    """The tables that are measured for it, or the models that have a row there; nothing is done."""
    asked: list[str] = []
    monkeypatch.setattr("f3amd_lib.text.stages.text_models.open_text_motions", lambda *_: None)
    for name in TEXT_MEASUREMENTS:
        monkeypatch.setitem(TEXT_MEASUREMENTS, name, lambda *_, name=name, **__: asked.append(name) or "table")
    for run in load_commands(paper)[claim_id]:
        assert run.startswith("python ") or main(shlex.split(run, comments=True)[1:]) == 0
    (entry,) = (entry for entry in load_paper_file("claims", paper)["claim"] if entry["id"] == claim_id)
    tables_of_ours = told(entry["statement"], "table") & set(TABLES)
    models = told(entry["statement"], "model") - set(load_paper_file("paper", paper)["others"])
    measured = load_paper_file("experiments", paper)
    reached = set(asked) | {row["model"] for name in asked for row in measured[name]["rows"]}
    needed = tables_of_ours if paper == "acmdm" else models
    assert needed <= reached and (needed or claim_id == "S4")


def test_a_window_of_another_length_is_for_what_the_ledger_asks_of_it(capsys, monkeypatch):
    monkeypatch.setattr("f3amd_lib.training.pipeline.prepare", lambda profile, **how: profile)
    assert main(["measure", "feet", "--profile", "smoke", "--window", "64"]) == 2
    assert "for quality, trained and walking" in capsys.readouterr().err


# ------------------------------------------------------------------------------------ rehearsed at smoke size

SMALL = "F3AMD-FNO-32"


@pytest.mark.long
@pytest.mark.parametrize(
    ("words", "table"),
    [
        (["measure", "quality", "--model", SMALL], "quality"),
        (["measure", "quality", "--model", SMALL, "--window", "64"], "quality"),
        (["measure", "trained", "walking", "--model", SMALL], "walking"),
        (["measure", "trained", "walking", "--model", SMALL, "--window", "64"], "walking"),
        (["measure", "foot_spectrum", "--model", SMALL], "foot_spectrum"),
        (["measure", "sensitivity"], "corruptions"),
        (["measure", "noise_use", "--model", SMALL], "x0_by_sigma"),
        (["measure", "feet", "--model", SMALL], "feet"),
        (["measure", "gradient_norm", "--model", SMALL], "gradient_norm"),
        (["bench", "--suite", "smoke", "--characters", "1"], "synthesis_time"),
        (["bench", "--training"], "training_time"),
    ],
    ids=lambda given: given if isinstance(given, str) else " ".join(given[:2]),
)
def test_a_command_runs_at_smoke_size(words, table, tmp_path_factory, monkeypatch):
    folder = tmp_path_factory.getbasetemp() / "rehearsal"
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(folder))
    monkeypatch.setattr(measurements, "_TRAINED", (SMALL,))
    # A classifier of so short a training may not tell styles; what it says is of no interest here.
    for module in (protocol, sensitivity):
        monkeypatch.setattr(module, "require_telling_styles", lambda classifier: None)
    assert main([*words, "--profile", "smoke"]) == 0
    rows = pd.read_csv(folder / "synthetic" / "smoke" / "records" / f"{table}.csv")
    assert len(rows) and rows.drop_duplicates().shape == rows.shape
