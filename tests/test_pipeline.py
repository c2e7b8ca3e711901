"""The road from a data set's name to a trained model, and the command line on top of it."""

import dataclasses

import pytest

import f3amd_lib.training.pipeline as pipeline
from f3amd_lib.data.packed import CACHE_DIR_VARIABLE
from f3amd_lib.ground.profiles import load_profile
from f3amd_lib.ground.records import read_table


@pytest.fixture(scope="module")
def trained_once(tmp_path_factory):
    """A model trained for four steps in a folder of its own; (folder, prepared, profile, model)."""
    folder, build = tmp_path_factory.mktemp("pipeline"), pipeline.presets.build_config
    with pytest.MonkeyPatch.context() as patch:
        # One narrow block: what is looked at here are files, and compiling is what takes time.
        narrow = {"depth": 1, "latent_width": 8}
        patch.setattr(pipeline.presets, "build_config", lambda *a, **settings: build(*a, **narrow | settings))
        patch.setenv(CACHE_DIR_VARIABLE, str(folder / "cache"))
        patch.setattr(pipeline, "runs_dir", lambda dataset, profile: folder / dataset / profile)
        profile = load_profile("smoke", "synthetic", train_steps=4, num_styles=2)
        prepared = pipeline.prepare(profile)
        model, history, origin = pipeline.obtain_model(prepared, profile, progress=False)
        assert origin == "trained now"
        assert history["step"].iloc[-1] == 4
        yield folder, prepared, profile, model


@pytest.fixture
def same_runs(trained_once, monkeypatch):
    folder = trained_once[0]
    monkeypatch.setattr(pipeline, "runs_dir", lambda dataset, profile: folder / dataset / profile)


def test_finished_model_is_found_again(trained_once, same_runs):
    _, prepared, profile, model = trained_once
    again, history, origin = pipeline.obtain_model(prepared, profile, progress=False)
    assert origin == "earlier run"
    assert again.record == model.record
    assert history["held_out_loss"].notna().any()


def test_record_names_data_terms_and_recipe(trained_once, same_runs):
    _, prepared, profile, model = trained_once
    _, record = read_table(pipeline.model_files(profile).history)
    assert record["model"] == profile.preset
    assert model.record["dataset_fingerprint"] == prepared.packed.fingerprint
    assert model.record["dataset_licence"] == prepared.packed.licence
    assert model.record["training"]["num_steps"] == profile.train_steps
    assert model.styles == prepared.packed.styles


def test_changed_settings_set_the_old_files_aside(trained_once, same_runs, monkeypatch):
    folder, prepared, profile, _ = trained_once
    files = pipeline.model_files(profile)
    before = files.model.read_bytes()
    asked = {}
    monkeypatch.setattr(pipeline, "train", lambda *args, **kwargs: asked.setdefault("yes", (None, None)))
    pipeline.obtain_model(prepared, dataclasses.replace(profile, seed=5), progress=False)
    assert asked
    name = profile.preset
    kept = files.model.with_name(f"{name}.old1.safetensors")
    assert kept.read_bytes() == before
    history, record = read_table(files.history.with_name(f"{name}.old1.history.csv"))
    assert record["model"] == name and len(history)
    put_back(files)


def put_back(files):
    """Undo setting aside."""
    for path in files.model.parent.glob("*.old1.*"):
        path.rename(path.with_name(path.name.replace(".old1", "")))


@pytest.mark.slow
def test_a_finished_model_without_its_state_is_not_overwritten(trained_once, same_runs):
    _, prepared, profile, model = trained_once
    files = pipeline.model_files(profile)
    before = files.model.read_bytes()
    files.state.rename(files.state.with_name("elsewhere"))
    pipeline.train(prepared, profile, progress=False)
    kept = files.model.with_name(f"{profile.preset}.old1.safetensors")
    assert kept.read_bytes() == before and files.model.exists()
    for path in files:
        path.unlink()
    files.state.with_name("elsewhere").rename(files.state)
    put_back(files)
    assert files.model.read_bytes() == before


def test_models_that_lie_there_are_listed(trained_once, same_runs, monkeypatch, tmp_path):
    profile = trained_once[2]
    assert pipeline.available_models(profile) == [profile.preset]
    laptop = dataclasses.replace(profile, name="laptop", dataset="bandai")
    # Shipped ones count on a laptop, whatever lies in runs/.
    assert {"F3AMD-FNO-96", "F3AMD-FNO-96-steady"} <= set(pipeline.available_models(laptop))
    longer = dataclasses.replace(laptop, window=64)
    assert pipeline.available_models(longer) == []


def test_shipped_weights_never_cross_to_another_skeleton(trained_once, same_runs, monkeypatch):
    folder, prepared, profile, model = trained_once
    laptop = dataclasses.replace(profile, name="laptop")
    shipped = folder / "pretrained" / "synthetic"
    other = dataclasses.replace(
        model, skeleton=dataclasses.replace(model.skeleton, offsets=1.5 * model.skeleton.offsets)
    )
    files = pipeline.model_files(laptop, folder=shipped)
    pipeline.save_model(files.model, other)
    monkeypatch.setattr(pipeline, "PRETRAINED_DIR", folder / "pretrained")
    monkeypatch.setattr(pipeline, "train", lambda *args, **kwargs: (None, None))
    *_, origin = pipeline.obtain_model(prepared, laptop, progress=False)
    assert origin == "trained now"
