"""Recipes of our own: one change each, and the measurements that ask networks about their noise."""

import dataclasses

import jax
import numpy as np
import pandas as pd
import pytest
from builders import HISTORY, WINDOW, packed_from, refused, tiny_camdm, tiny_trained, wandering_motion
from scipy import stats

from f3amd_lib.diffusion.schedules import variance_preserving_cosine
from f3amd_lib.experiments import measure, recipes
from f3amd_lib.ground.papers import load_paper_table
from f3amd_lib.ground.profiles import load_profile, repository_root
from f3amd_lib.ground.records import read_table
from f3amd_lib.networks import presets
from f3amd_lib.training.pipeline import PreparedData
from f3amd_lib.training.recipe import paper_recipe

PROFILE = load_profile("smoke", "synthetic", batch_size=2, window=WINDOW)


@pytest.fixture(scope="module")
def prepared():
    clips = [(wandering_motion(60, seed), seed % 2, split) for seed, split in ((0, 0), (1, 1))]
    return PreparedData(packed_from(clips), WINDOW, HISTORY)


def changed(first: dict, second: dict) -> set[str]:
    return {name for name in first if first[name] != second[name]}


def test_every_recipe_changes_one_thing(prepared):
    paper = recipes.RECIPES["paper"].config(100, 8, 0)
    assert paper == paper_recipe("F3AMD-FNO-96", 100, batch_size=8, seed=0)
    base = prepared.model_config("F3AMD-FNO-96", num_kept_modes=5).to_dict()
    for name, recipe in recipes.RECIPES.items():
        if name in ("paper", "plus"):
            continue
        network = prepared.model_config(recipe.preset, num_kept_modes=5, **recipe.network)
        training = recipe.config(100, 8, 0).to_dict()
        ours = changed(base, network.to_dict()) | changed(paper.to_dict(), training)
        assert len(ours) == 1 or name == "warm-up-and-cosine", (name, ours)
    warm = recipes.RECIPES["warm-up-and-cosine"].config(100, 8, 0)
    assert (warm.schedule, warm.warmup_steps, warm.learning_rate) == ("warmup_cosine", 10, 2e-3)
    plus = recipes.RECIPES["plus"].config(100, 8, 0)
    assert plus.own_history_share == presets.find_preset("F3AMD-FNO-96-plus").training[
        "own_history_share"
    ]  # fmt: skip


def test_unknown_recipe_names_the_nearest():
    refused("'wide-decodr'; did you mean 'wide-decoder'", recipes.find_recipe, "wide-decodr")
    refused("'residual-prio'; did you mean", recipes.find_recipe, "higher-learning-rate+residual-prio")


def test_two_changes_in_one_recipe_are_both_made(prepared):
    both = recipes.find_recipe("residual-prior+higher-learning-rate")
    one, other = (recipes.RECIPES[name] for name in both.name.split("+"))
    assert (both.network, both.training) == (one.network, other.training)
    assert both.config(100, 8, 0) == other.config(100, 8, 0)
    assert prepared.model_config(both.preset, num_kept_modes=5, **both.network).residual_prior
    assert one.change in both.change and other.change in both.change
    for name in ("log-normal-noise+mixed-noise", "residual-prior+plus"):
        refused("change the same thing, or start from unlike networks", recipes.find_recipe, name)


@pytest.fixture
def two_recipes(monkeypatch):
    """Two rows only, on networks of one narrow block."""
    build = presets.build_config
    monkeypatch.setattr(
        presets,
        "build_config",
        lambda *a, **k: build(*a, **{**k, "depth": 1, "latent_width": 8, "num_kept_modes": WINDOW // 2 + 1}),
    )
    rows = {name: recipes.RECIPES[name] for name in ("paper", "residual-prior")}
    monkeypatch.setattr(measure, "RECIPES", rows)
    monkeypatch.setattr(recipes, "RECIPE_STEPS", {"smoke": 2})
    monkeypatch.setattr(measure, "RECIPE_STEPS", {"smoke": 2})
    return rows


@pytest.mark.slow
def test_recipes_are_trained_measured_and_gone_on_with(prepared, two_recipes, tmp_path, monkeypatch):
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path))
    monkeypatch.setattr(measure, "runs_dir", lambda *names: tmp_path.joinpath("runs", *names))
    path = measure.measure_recipes(prepared, PROFILE)
    table, record = read_table(path)
    assert record["num_steps"] == 2 and record["batch_size"] == 2
    assert list(table["recipe"]) == ["paper", "paper", "residual-prior", "residual-prior"]
    assert list(table["steps"]) == [8, 1, 8, 1]
    assert np.isfinite(table.select_dtypes("number")).all().all()
    assert set(table["change"]) == {recipe.change for recipe in two_recipes.values()}
    assert table["weights"].nunique() == 2
    folder = tmp_path / "runs" / "synthetic" / "smoke" / "recipes" / "paper"
    assert list(folder.glob("F3AMD-FNO-96*.history.csv"))

    def refuse(*arguments, **settings):
        raise AssertionError("a row that is there was trained again")

    monkeypatch.setattr(measure, "train_recipe", refuse)
    assert measure.measure_recipes(prepared, PROFILE) == path
    refused("leave --model out", measure.measure_recipes, prepared, PROFILE, ["F3AMD-FNO-96"])
    # A run on other data makes way, under another name.
    packed = dataclasses.replace(prepared.packed, fingerprint="others")
    others = PreparedData(packed, WINDOW, HISTORY)
    monkeypatch.setattr(recipes, "train", lambda *a, **k: (None, None))
    recipes.train_recipe(prepared, PROFILE, "paper", folder=folder.parent, progress=False)
    assert not list(folder.glob("*.old*"))
    recipes.train_recipe(others, PROFILE, "paper", folder=str(folder.parent), progress=False)
    assert len(list(folder.glob("F3AMD-FNO-96*.old1*"))) == 4


@pytest.mark.slow
def test_noise_use_asks_every_model_at_its_own_levels(prepared, tmp_path, monkeypatch):
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path))
    models = {
        "F3AMD-FNO-32": tiny_trained(),
        "CAMDM": tiny_trained(config=tiny_camdm(), diffusion=variance_preserving_cosine(4)),
    }
    asked = []

    def obtain(prepared, profile, *, preset):
        asked.append(preset)
        return models[preset], None, "earlier run"

    monkeypatch.setattr(measure, "obtain_model", obtain)
    monkeypatch.setattr(measure, "available_models", lambda profile: list(models))
    monkeypatch.setattr(measure, "SIGMAS", (0.1, 128.0))
    path = measure.measure_noise_use(prepared, PROFILE)
    table, _ = read_table(path)
    errors, _ = read_table(path.with_name("x0_by_sigma.csv"))
    levels = errors.groupby("model")["sigma"].apply(list)
    assert levels["F3AMD-FNO-32"] == pytest.approx([0.1, 128.0])
    # A network that is told the number of a step is asked at its own levels.
    assert levels["CAMDM"] == pytest.approx(variance_preserving_cosine(4).levels.tolist(), rel=1e-6)
    assert set(errors["noise"]) == {"variance_exploding", "variance_preserving_cosine"}
    assert set(table["model"]) == set(models) and "x0_error_ratio" in table
    use, _ = read_table(path.with_name("input_use.csv"))
    assert set(zip(use["model"], use["metric"], strict=True)) == {
        (model, metric) for model in models for metric in ("use_of_x", "use_of_sigma")
    }
    before = len(errors)
    # Nothing changed: nothing new. Other weights: that model alone anew.
    measure.measure_noise_use(prepared, PROFILE)
    assert len(read_table(path.with_name("x0_by_sigma.csv"))[0]) == before
    first = table[table["model"] == "CAMDM"]["x0_error_ratio"].tolist()
    tiny = models["CAMDM"]
    doubled = jax.tree.map(lambda leaf: 2 * leaf, tiny.params)
    models["CAMDM"] = dataclasses.replace(tiny, params=doubled)
    measure.measure_noise_use(prepared, PROFILE)
    again, _ = read_table(path)
    assert len(again) == len(table)
    assert again[again["model"] == "CAMDM"]["x0_error_ratio"].tolist() != first


def test_how_long_a_model_was_trained_is_written_down(prepared, tmp_path, monkeypatch):
    """Windows are steps times batch; the fall is that of the held-out loss over the last quarter."""
    monkeypatch.setenv("F3AMD_RESULTS_DIR", str(tmp_path))
    tiny = tiny_trained()
    tiny = dataclasses.replace(tiny, record=tiny.record | {"training": {"num_steps": 100, "batch_size": 16}})
    losses = [4.0, np.nan, 2.0, 1.8, 1.5]  # watched at 20, 60, 80 and 100 of 100 steps
    history = pd.DataFrame({"step": [20, 40, 60, 80, 100], "held_out_loss": losses})
    histories = {"F3AMD-FNO-32": history, "F3AMD-FNO-48": history[["step"]]}
    monkeypatch.setattr(measure, "obtain_model", lambda prepared, profile, *, preset: (tiny, histories[preset], ""))
    monkeypatch.setattr(measure, "available_models", lambda profile: list(histories))
    table, record = read_table(measure.measure_trained(prepared, PROFILE))
    found = table.set_index(["model", "metric"])["value"]
    assert found["F3AMD-FNO-32", "windows"] == 1600 and found["F3AMD-FNO-32", "held_out_fall"] == pytest.approx(
        1.0 - 1.5 / (2.0 - 0.2 * np.log(75 / 60) / np.log(80 / 60))
    )
    assert np.isnan(found["F3AMD-FNO-48", "held_out_fall"]) and set(record["weights_digests"]) == set(histories)
    # Of a training that was gone on with, all legs count, as on its card.
    tiny = dataclasses.replace(tiny, record=tiny.record | {"windows_seen": 5000})
    table, _ = read_table(measure.measure_trained(prepared, PROFILE, ["F3AMD-FNO-32"]))
    assert table.set_index(["model", "metric"])["value"]["F3AMD-FNO-32", "windows"] == 5000


def test_what_notebook_15_says_of_single_changes_follows_from_the_record():
    rows, _ = read_table(repository_root() / "paper_figures/bandai/laptop/records/campaign.csv")
    rows = rows.query("model == 'F3AMD-FNO-96' and seed == 0 and window_frames == 32 and steps in [0, 8]")
    table = rows.pivot(index=["recipe", "windows"], columns="metric", values="value")
    short, longer = (table.xs(windows, level="windows") for windows in (200_000, 400_000))
    pair = short.loc["residual-prior+higher-learning-rate"]
    short = short[~short.index.str.contains("+", regex=False)]
    users = {"block-residual", "residual-prior", "skip-and-output-scaling", "log-normal-noise"}
    assert set(short.index[short["x0_error_ratio"] < 0.8]) == users
    assert short["x0_error_ratio"].drop(users).min() > 0.9 and len(short) == 12  # eleven changes and the paper's text
    # Noise that stays in the motion, and joints that tremble.
    assert short["seed_spread"][["skip-and-output-scaling", "log-normal-noise"]].round().tolist() == [10, 6]
    assert short["joint_acceleration"]["skip-and-output-scaling"] > 5 * short["joint_acceleration"]["paper"]
    # Twice as long.
    assert longer["x0_error_ratio"][["block-residual", "residual-prior"]].round(2).tolist() == [0.65, 0.19]
    loss = table["held_out_loss"]
    assert loss["block-residual", 400_000] == pytest.approx(loss["paper", 400_000], rel=0.03)
    assert loss["residual-prior", 400_000] == pytest.approx(loss["paper", 800_000], rel=0.03)
    assert short["held_out_loss"].idxmin() == "higher-learning-rate"
    assert loss["higher-learning-rate", 200_000] == pytest.approx(loss["paper", 400_000], rel=0.05)
    assert longer["x0_error_ratio"]["higher-learning-rate"] > 0.9
    # Two changes together.
    assert pair["held_out_loss"] == pytest.approx(loss["paper", 800_000], rel=0.03)
    said = {"held_out_loss": 0.186, "x0_error_ratio": 0.17, "seed_spread": 1.9}
    for name, figure in said.items():
        assert pair[name] == pytest.approx(figure, rel=0.03), name
    assert round(loss["paper", 800_000], 3) == 0.189 and round(short["seed_spread"]["paper"], 1) == 0.4
    for name in ("foot_sliding", "joint_acceleration"):
        assert pair[name] == pytest.approx(short[name]["higher-learning-rate"], rel=0.06), name
    # A loss is no walk.
    assert (loss["history-anchor"] < loss["paper"].loc[[200_000, 400_000]]).all()
    shaking = table["joint_acceleration"]["history-anchor"]
    assert shaking[200_000] > 5 * shaking[400_000]


def test_what_notebook_15_says_of_length_follows_from_the_record():
    records = repository_root() / "paper_figures/bandai/laptop/records"
    table, _ = read_table(records / "campaign.csv")
    rows = table.query("model == 'F3AMD-FNO-96' and window_frames == 32 and steps in [0, 8]")
    of = lambda run: rows[rows["run"] == f"F3AMD-FNO-96-{run}"].pivot(index="windows", columns="metric", values="value")
    eyes = lambda run: rows[rows["run"] == f"F3AMD-FNO-96-{run}"].groupby("windows")["classifier"].first()
    long, thousand = of("seed0"), 1000
    assert long.index.tolist() == [windows * thousand for windows in (200, 400, 800, 1600, 3200, 6400)]
    least, middle, late, most = (long.loc[windows * thousand] for windows in (200, 800, 3200, 6400))
    assert middle["FID"] / least["FID"] == pytest.approx(1 / 5, rel=0.1)
    assert middle["foot_sliding"] / least["foot_sliding"] == pytest.approx(0.8, abs=0.03)
    assert round(late["FID"]) == round(most["FID"]) == 19
    assert most["foot_sliding"] / late["foot_sliding"] > 0.95
    falling = long[["trajectory_error", "joint_acceleration", "held_out_loss"]].diff().iloc[1:]
    assert (falling < 0).all(axis=None) and (most / late)[["trajectory_error", "joint_acceleration"]].max() < 0.9
    assert len(set(eyes("seed0"))) == 1
    assert [round(one["x0_error_ratio"], 2) for one in (least, most)] == [0.96, 0.91]
    leaves = (long["held_out_loss"] / long["held_out_loss"].shift())[1:]
    assert (100 * leaves).round().tolist() == [81, 84, 86, 92, 96]
    # Its answers move little with its noise, less and less with the level, and one step trembles as eight do.
    uses = [round(one[name], 2) for one in (least, most) for name in ("use_of_x", "use_of_sigma")]
    assert uses == [0.60, 0.83, 0.33, 0.38]
    one_step = table.query("run == 'F3AMD-FNO-96-seed0' and metric == 'joint_acceleration' and steps == 1")
    one_step = one_step.set_index("windows")["value"]
    assert (round(one_step[200 * thousand], 1), round(least["joint_acceleration"], 1)) == (3.5, 5.2)
    assert (round(one_step[6400 * thousand], 1), round(most["joint_acceleration"], 1)) == (1.9, 2.0)
    # The family: as far after 1.6 million windows as this one after a half and a quarter of them.
    family = table.query("recipe == 'paper' and seed == 0 and window_frames == 32 and steps in [0, 8]")
    family = family.pivot(index=["model", "windows"], columns="metric", values="value")
    assert family.loc[["F3AMD-FNO-32", "F3AMD-Transformer-64"]].index.get_level_values(1).max() == 1600 * thousand
    said = {
        ("F3AMD-Transformer-64", 1600): (0.199, 3.1, 0.95), ("F3AMD-FNO-96", 800): (0.189, 2.9, 0.94),
        ("F3AMD-FNO-32", 1600): (0.257, 3.7, 0.97), ("F3AMD-FNO-96", 400): (0.225, 3.5, 0.96),
    }  # fmt: skip
    for (name, windows), figures in said.items():
        row = family.loc[(name, windows * thousand), ["held_out_loss", "joint_acceleration", "x0_error_ratio"]]
        assert tuple(round(value, places) for value, places in zip(row, (3, 1, 2), strict=True)) == figures
    # The resting foot hardly changes.
    real = read_table(records / "quality.csv")[0].query("model == 'real'").set_index("metric")["value"]
    assert round(late["foot_alternation"], 2) == round(most["foot_alternation"], 2) == 0.13
    assert round(real["foot_alternation"], 1) == 1.9
    assert round(real["IRD"], 1) == 4.0  # more than it steps at a seam, less than CAMDM does
    assert most["joint_acceleration"] / real["joint_acceleration"] == pytest.approx(2.9, abs=0.05)
    # Where a power law would end at the paper's length: nearly twice what real joints tremble, or less than they do.
    x, y = np.log(long.index.to_numpy(float)), np.log(long["joint_acceleration"].to_numpy())
    fit = stats.linregress(x, y)
    end = fit.intercept + fit.slope * np.log(199_478_800)
    scatter = np.sqrt(np.sum((y - fit.intercept - fit.slope * x) ** 2) / 4)
    away = (np.log(199_478_800) - x.mean()) ** 2 / np.sum((x - x.mean()) ** 2)
    half = stats.t.ppf(0.975, 4) * scatter * np.sqrt(1 / 6 + away)
    low, high = np.exp([end - half, end + half]) / real["joint_acceleration"]
    assert low < 0.7 and high == pytest.approx(1.9, rel=0.05)
    # Two changes, seen by the same classifier as another seed of the paper's text.
    pair = "residual-prior+higher-learning-rate-seed0"
    assert eyes(pair).iloc[0] == eyes("seed1").iloc[0]
    assert [round(of(run).loc[200 * thousand, "FID"]) for run in (pair, "seed1")] == [50, 133]
    second = "residual-prior+higher-learning-rate-seed1"
    both = of(second).loc[200 * thousand]
    assert (round(both["held_out_loss"], 3), round(both["x0_error_ratio"], 2), round(both["FID"])) == (0.181, 0.17, 32)
    other = of("residual-prior+history-input-seed0").loc[200 * thousand]
    assert (round(other["held_out_loss"], 3), round(other["x0_error_ratio"], 2), round(other["FID"])) == (
        0.232,
        0.37,
        72,
    )
    assert {*eyes("residual-prior+history-input-seed0")} == {*eyes("seed0")}
    assert eyes(second).iloc[0] == eyes("higher-learning-rate-seed1").iloc[0]
    # CAMDM after a thirty-second of the windows, so in a sixth of the time: level on the path and in trembling, ahead
    # in feet and the use of noise, behind in postures.
    short = table.query("windows == 200_000 and steps in [0, 8]").set_index("run")
    camdm, rate = (short.loc[run] for run in ("CAMDM-seed0", "F3AMD-FNO-96-higher-learning-rate-seed1"))
    assert set(rate["classifier"]) == set(camdm["classifier"])
    camdm, rate = (rows.set_index("metric")["value"] for rows in (camdm, rate))
    beside = {
        "trajectory_error": (0.051, 0.051), "joint_acceleration": (2.0, 2.1), "foot_sliding": (0.67, 0.61),
        "IRD": (2.2, 8.1), "x0_error_ratio": (0.91, 0.64), "foot_alternation": (0.13, 0.34), "FID": (19, 27),
    }  # fmt: skip
    for metric, (longer, shorter) in beside.items():
        assert most[metric] == pytest.approx(longer, rel=0.03), metric
        assert camdm[metric] == pytest.approx(shorter, rel=0.03), metric
    # Twice the windows put it ahead, or level.
    twice = family.loc[("CAMDM", 400 * thousand)]
    assert set(table.query("run == 'CAMDM-seed0'")["classifier"]) == set(eyes("seed0"))
    said = {
        "trajectory_error": (0.0437, 0.051), "joint_acceleration": (1.7, 2.0), "FID": (20, 19), "IRD": (6.9, 2.2),
        "foot_sliding": (0.55, 0.67), "foot_alternation": (0.62, 0.13), "x0_error_ratio": (0.57, 0.91),
        "use_of_x": (1.83, 0.33),
    }  # fmt: skip
    for metric, (theirs, ours) in said.items():
        assert (twice[metric], most[metric]) == pytest.approx((theirs, ours), rel=0.025), metric
    ships = read_table(records / "quality.csv")[0].query("model == 'CAMDM' and steps == 8").set_index("metric")["value"]
    assert (round(ships["trajectory_error"], 3), round(ships["joint_acceleration"], 1)) == (0.047, 1.4)
    assert round(ships["FID"]) == 53
    # At as many windows, through the same classifier, the higher rate alone: a second seed of it.
    assert (round(rate["held_out_loss"], 3), round(rate["x0_error_ratio"], 2)) == (0.210, 0.95)
    assert (round(rate["FID"]), round(camdm["FID"]), round(least["FID"])) == (23, 27, 137)
    assert (round(rate["foot_sliding"], 2), round(rate["joint_acceleration"], 1)) == (0.76, 2.9)
    steps = read_table(repository_root() / "paper_figures/synthetic/laptop/records/training_time.csv")[0]
    steps = steps.query("window_frames == 32").set_index("model")["value"]
    cost = steps / steps["F3AMD-FNO-96"]
    assert 4.5 < cost["CAMDM"] < 5.5 and 0.9 < cost["F3AMD-Transformer-64"] < 1.1 and 0.45 < cost["F3AMD-FNO-32"] < 0.55


def test_what_notebook_15_says_of_ablations_follows_from_the_record():
    rows, _ = read_table(repository_root() / "paper_figures/bandai/laptop/records/campaign.csv")
    asked = "recipe == 'paper' and windows == 200_000 and window_frames == 32 and steps in [0, 8]"
    rows = rows.query(asked + " and model.str.startswith('F3AMD-') and model != 'F3AMD-FNO-32'")
    table = rows.pivot_table(index="model", columns="metric", values="value")
    variants = table.drop("F3AMD-FNO-96").rename(index=lambda name: name.removeprefix("F3AMD-").removeprefix("FNO-96-"))
    seeds = rows[rows["model"] == "F3AMD-FNO-96"].pivot(index="run", columns="metric", values="value")
    # Equal losses, other walks.
    assert sorted(seeds["held_out_loss"].round(3)) == [0.274, 0.280, 0.287]
    spread = seeds.max() - seeds.min()
    assert (round(spread["held_out_loss"], 3), round(spread["x0_error_ratio"], 3)) == (0.013, 0.004)
    assert seeds["joint_acceleration"].max() > 2 * seeds["joint_acceleration"].min()
    ranges = {"trajectory_error": (0.10, 0.23), "joint_acceleration": (4.1, 8.9), "IRD": (4.7, 14.0)}
    for metric, (least, most) in ranges.items():
        assert seeds[metric].agg(["min", "max"]).tolist() == pytest.approx([least, most], rel=0.02), metric
    inside = (variants >= seeds.min()) & (variants <= seeds.max())
    assert inside[["trajectory_error", "joint_acceleration", "IRD"]].to_numpy().mean() > 0.75
    layers = ["m8", "m12", "m14", "DCT-96", "weighted-FNO-96", "reduced-rank-FNO-96"]
    assert inside.loc[layers, ["trajectory_error", "joint_acceleration", "IRD"]].all(axis=None)
    # What leaves the band.
    walks, ratio = variants["trajectory_error"], variants["x0_error_ratio"]
    assert walks.idxmax() == ratio.idxmax() == "m1" and (round(walks["m1"], 2), round(ratio["m1"], 2)) == (0.26, 0.99)
    loss = variants["held_out_loss"]
    assert loss.nlargest(4).round(2).to_dict() == {
        "Transformer-64-linear": 0.41, "Transformer-64": 0.35, "linear": 0.33, "concatenation": 0.33,
    }  # fmt: skip
    assert walks.idxmin() == "concatenation" and round(walks.min(), 2) == 0.09
    shaking = variants["joint_acceleration"]
    assert shaking.idxmax() == "Transformer-64" and round(shaking.max(), 1) == 10.5
    calm = shaking[shaking < seeds["joint_acceleration"].min()]
    assert calm.round(1).to_dict() == {"AdaLN-zero": 2.8, "m4": 3.2, "cross-attention": 3.2, "no-IRD": 3.5}
    by_eyes = rows[rows["metric"] == "FID"].set_index(["classifier", "run"])["value"]
    assert by_eyes.idxmax()[1] == "F3AMD-Transformer-64-seed0" and round(by_eyes.max()) == 1090
    first, second, third = (by_eyes[name] for name in ("3e50a95e2c44", "67e5a68238c9", "4e6bb8c28b27"))
    wide = variants.loc["Transformer-96"]
    assert (round(wide["held_out_loss"], 3), round(wide["joint_acceleration"], 1)) == (0.295, 6.2)
    assert third.round().sort_values().to_dict() == {
        "F3AMD-FNO-96-seed0": 137, "F3AMD-Transformer-96-seed0": 247, "F3AMD-Transformer-64-seed0": 1090,
    }  # fmt: skip
    assert first.nsmallest(1).round().to_dict() == {"F3AMD-FNO-96-cross-attention-seed0": 70}
    two = {"F3AMD-FNO-96-no-IRD-seed0": 71, "F3AMD-FNO-96-cross-attention-seed1": 105}
    assert second.nsmallest(2).round().to_dict() == two
    assert [round(first["F3AMD-FNO-96-seed1"]), round(second["F3AMD-FNO-96-seed2"])] == [133, 451]
    losses = rows.query("model == 'F3AMD-FNO-96-cross-attention' and metric == 'held_out_loss'")["value"]
    assert sorted(losses.round(3)) == [0.256, 0.260] and losses.max() < seeds["held_out_loss"].min()
    assert sorted(seeds["FID"].round()) == [133, 137, 451]
    assert round(variants["IRD"]["no-IRD"]) == 10 and sorted(seeds["IRD"].round(1)) == [4.7, 6.4, 14.0]
    # CAMDM, 96 wide.
    seen = read_table(repository_root() / "paper_figures/bandai/laptop/records/campaign.csv")[0]
    seen = seen.query("windows == 200_000 and steps == 8 and classifier == '4e6bb8c28b27'")
    seen = seen[seen["model"].isin(["CAMDM-96", "CAMDM", "F3AMD-FNO-96"]) & (seen["recipe"] == "paper")]
    seen = seen.pivot(index="metric", columns="model", values="value")[["CAMDM-96", "CAMDM", "F3AMD-FNO-96"]]
    assert seen.loc["style_coverage"].round().tolist() == [82, 99, 60]
    assert seen.loc["EMD"].tolist() == pytest.approx([9.8, 6.3, 13], rel=0.03)
    table_12 = load_paper_table(12).query("metric == 'style_coverage'")
    assert table_12["value"].min() == 2 and presets.find_preset("CAMDM-96").network["latent_width"] == 96
    # What the paper has of them.
    table_10 = load_paper_table(10).query("metric == 'FID'").set_index("model")["value"]
    assert table_10.idxmax() == "F3AMD-FNO-96, m=1"
    table_9 = load_paper_table(9).query("metric == 'style_coverage'").set_index("model")["value"]
    assert "linear" in table_9.filter(like="FNO-96").idxmin()
    # The one with a way around its blocks looks at its noise.
    assert round(ratio.pop("AdaLN-zero"), 2) == 0.70 and (ratio.round(2) >= 0.95).all()
    zero = rows.query("model == 'F3AMD-FNO-96-AdaLN-zero' and metric == 'x0_error_ratio'")
    assert zero.sort_values("seed")["value"].round(2).tolist() == [0.71, 0.70]
    # Thirteen rows of Tables 8 to 11, two Transformers, and no IRD loss.
    assert len(variants) == 16
