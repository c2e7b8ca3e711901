"""Records, tables, the paper's numbers, figures and pictures."""

import dataclasses
import json
import os
import subprocess
import tempfile
from pathlib import Path

import matplotlib
import numpy as np
import pandas as pd
import pytest
from builders import cut_off, refused
from matplotlib.collections import LineCollection
from matplotlib.colors import to_rgb
from PIL import Image

from f3amd_lib.drawing import pictures, stick_figures
from f3amd_lib.drawing import style as figures
from f3amd_lib.ground import papers, records, stored, tables
from f3amd_lib.ground.names import counted_cores
from f3amd_lib.motion.root_paths import named_path
from f3amd_lib.motion.rotations import matrix_from_euler, matrix_from_yaw
from f3amd_lib.motion.skeleton import Motion, Skeleton
from f3amd_lib.networks.presets import find_preset


def make_motion(num_frames=120, fps=30.0, name="test walk"):
    """A stick figure with swinging legs that walks 1.2 m/s along +Z while turning a little."""
    names = ("Hips", "Chest", "Neck", "Head")
    parents, offsets = [-1, 0, 1, 2], [[0, 0, 0], [0, 0.25, 0], [0, 0.25, 0], [0, 0.1, 0]]
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        first = len(parents)
        names += (f"{side}Shoulder", f"{side}Wrist", f"{side}Hip", f"{side}Ankle", f"{side}Toe")
        parents += [1, first, 0, first + 2, first + 3]
        offsets += [[sign * 0.18, 0.2, 0], [0, -0.5, 0.05], [sign * 0.1, 0, 0], [0, -0.85, 0], [0, -0.05, 0.13]]
    skeleton = Skeleton(names, tuple(parents), np.array(offsets), ((3, (0.0, 0.2, 0.0)),))
    time = np.arange(num_frames) / fps
    rotations = np.tile(np.eye(3), (num_frames, len(names), 1, 1))
    rotations[:, 0] = matrix_from_yaw(0.3 * np.sin(time))
    for side, sign in (("Left", 1.0), ("Right", -1.0)):
        swing = 25.0 * sign * np.sin(2 * np.pi * time)
        rotations[:, names.index(f"{side}Hip")] = matrix_from_euler("X", swing[:, None])
        rotations[:, names.index(f"{side}Shoulder")] = matrix_from_euler("X", -swing[:, None])
    root = np.stack([0 * time, 0.9 + 0 * time, 1.2 * time], axis=-1)
    return Motion(skeleton, root, rotations, fps=fps, name=name)


# ------------------------------------------------------------------------------------- records


def record(**changes):
    return records.run_record(**({"profile": "smoke", "dataset": "synthetic", "seed": 3} | changes))


FRAME = pd.DataFrame({"model": ["a", "b"], "value": [0.1 + 0.2, float("nan")], "steps": [8, 1]})


def test_record_says_what_ran_where():
    @dataclasses.dataclass
    class Data:
        name: str = "bandai"
        fingerprint: str = "ab12"
        licence: str = "CC BY-NC 4.0"
        credit: str = "somebody"

    made = record(dataset=Data(), steps=np.int64(8), times=np.array([1.5, 2.5]))
    assert made["profile"] == "smoke" and made["seed"] == 3
    assert made["dataset"] == "bandai" and made["dataset_fingerprint"] == "ab12"
    assert made["steps"] == 8 and made["times"] == [1.5, 2.5]
    assert set(made["versions"]) >= {"python", "jax", "flax", "optax", "numpy"}
    assert made["versions"]["numpy"] == np.__version__
    assert made["cores"] >= 1 and made["device_kind"] and made["date_utc"].endswith("Z")
    assert {"git_commit", "git_dirty", "library_version"} <= set(made)
    json.dumps(made, allow_nan=False)


def test_record_tells_no_folder_of_the_machine(tmp_path):
    home = os.path.expanduser("~")
    made = record(
        weights=Path(home) / "models" / "best.safetensors",
        note=f"read from {home}/data/walk.bvh and {tempfile.gettempdir()}/x",
        elsewhere=Path("/somewhere/private/walk.csv"),
        inside=Path(records.__file__),
        deep={"list": [str(tmp_path)]},
    )
    text = json.dumps(made)
    assert home + "/" not in text and tempfile.gettempdir() + "/" not in text
    assert made["weights"].endswith("models/best.safetensors")
    assert made["elsewhere"] == ".../walk.csv"
    assert made["inside"] == "./f3amd_lib/ground/records.py"


def test_record_refuses_taken_names_and_odd_values():
    refused("already has 'versions'", record, versions=1)
    refused("cannot hold", record, thing=object())
    refused("cannot hold", record, thing=np.longdouble(1.5))
    refused("profile must be a name", record, profile=None)


def test_record_without_git(monkeypatch):
    def no_git(*arguments, **options):
        raise FileNotFoundError("git")

    monkeypatch.setattr(subprocess, "run", no_git)
    made = record()
    assert made["git_commit"] is None and made["git_dirty"] is None


def test_git_state_of_a_checkout(tmp_path, monkeypatch):
    """Commit and dirty flag follow the library's code, not its results."""
    library = tmp_path / "f3amd_lib"
    library.mkdir()
    (library / "records.py").write_text("one\n")

    def git(*arguments):
        identity = ["-c", "user.name=t", "-c", "user.email=t@example.org"]
        done = subprocess.run(
            ["git", "-C", str(tmp_path), *identity, *arguments], check=True, capture_output=True, text=True
        )
        return done.stdout.strip()

    monkeypatch.setattr(records, "_REPOSITORY", tmp_path)
    monkeypatch.setattr(records, "_LIBRARY", library)
    monkeypatch.setattr(records, "__file__", str(library / "records.py"))
    git("init", "-q")
    assert records._git_state() == (None, None)  # not tracked: somebody else's checkout
    git("add", ".")
    git("commit", "-q", "-m", "first")
    commit = git("rev-parse", "HEAD")
    assert records._git_state() == (commit, False)
    (tmp_path / "table.csv").write_text("result\n")
    assert records._git_state() == (commit, False)
    (tmp_path / "f3amd_companion").mkdir()
    (tmp_path / "f3amd_companion" / "measure.py").write_text("one\n")
    assert records._git_state() == (commit, True)
    (tmp_path / "f3amd_companion" / "measure.py").unlink()
    (library / "records.py").write_text("two\n")
    assert records._git_state() == (commit, True)


def test_same_question_same_hash():
    assert records.record_hash(record()) == records.record_hash(record())
    assert records.record_hash(record()) != records.record_hash(record(seed=4))
    assert records.record_hash(record(steps=8)) != records.record_hash(record(steps=1))
    elsewhere = record() | {"device_kind": "another", "date_utc": "2000-01-01T00:00:00Z"}
    assert records.record_hash(elsewhere) == records.record_hash(record())


def test_table_round_trip(tmp_path):
    path = records.write_table(tmp_path / "deep" / "quality.csv", FRAME, record())
    frame, made = records.read_table(path)
    pd.testing.assert_frame_equal(frame, FRAME)
    assert made["table"]["rows"] == 2 and made["table"]["columns"] == ["model", "value", "steps"]
    assert sorted(file.name for file in path.parent.iterdir()) == ["quality.csv", "quality.json"]


def test_floats_come_back_exactly(tmp_path):
    values = np.random.default_rng(0).normal(size=2000) * 10.0 ** np.arange(-10, 10).repeat(100)
    path = records.write_table(tmp_path / "floats.csv", pd.DataFrame({"value": values}), record())
    np.testing.assert_array_equal(records.read_table(path)[0]["value"], values)


def test_table_survives_other_line_ends(tmp_path):
    path = records.write_table(tmp_path / "quality.csv", FRAME, record())
    path.write_bytes(path.read_bytes().replace(b"\n", b"\r\n"))
    pd.testing.assert_frame_equal(records.read_table(path)[0], FRAME)


def test_digests_stay_text_where_they_look_like_numbers(tmp_path):
    digests = {"weights": ["912345678901"] * 2, "classifier": ["1e10", None], "commit": ["9548690e74", "00042"]}
    table = pd.DataFrame({"value": [0.1, 2.0], **digests})
    records.write_table(tmp_path / "rows.csv", table, record())
    back = records.read_table(tmp_path / "rows.csv")[0]
    assert back["weights"].tolist() == digests["weights"] and back["commit"].tolist() == digests["commit"]
    assert back["classifier"][0] == "1e10" and pd.isna(back["classifier"][1]) and back["value"].tolist() == [0.1, 2.0]


def test_table_without_its_record_is_refused(tmp_path):
    path = records.write_table(tmp_path / "quality.csv", FRAME, record())
    path.with_suffix(".json").unlink()
    refused(r"quality\.csv: has no run record quality\.json", records.read_table, path)
    refused("without a run record", records.write_table, path, FRAME, record())
    with pytest.raises(FileNotFoundError, match="no such table"):
        records.read_table(tmp_path / "other.csv")


def test_edited_table_and_broken_record_are_refused(tmp_path):
    path = records.write_table(tmp_path / "quality.csv", FRAME, record())
    path.write_text(path.read_text().replace("a,", "better,"))
    refused("not the table that quality.json describes", records.read_table, path)
    path.with_suffix(".json").write_text("{")
    refused(r"quality\.json: not a readable run record", records.read_table, path)


@pytest.mark.parametrize("key", ["dataset", "profile"])
def test_tables_of_other_runs_are_never_overwritten(tmp_path, key):
    path = records.write_table(tmp_path / "quality.csv", FRAME, record())
    before = path.read_bytes()
    refused(f"holds results of {key}", records.write_table, path, FRAME.head(1), record(**{key: "other"}))
    assert path.read_bytes() == before
    records.write_table(path, FRAME.head(1), record(seed=9))  # the same question, measured again
    assert len(records.read_table(path)[0]) == 1


def test_bad_tables_are_refused(tmp_path):
    refused(r"quality.txt: tables are written as \.csv", records.write_table, tmp_path / "quality.txt", FRAME, record())
    refused("no rows", records.write_table, tmp_path / "quality.csv", FRAME.head(0), record())
    refused("has no 'profile'", records.write_table, tmp_path / "quality.csv", FRAME, {"dataset": "x", "seed": 0})
    assert not list(tmp_path.iterdir())


# ------------------------------------------------------------------------------------- papers

ROWS = {1: 306, 2: 22, 3: 162, 4: 102, 5: 72, 6: 18, 7: 34, 8: 36, 9: 27, 10: 54, 11: 40, 12: 18}


@pytest.mark.parametrize("number", ROWS)
def test_paper_tables_are_whole_and_tidy(number):
    frame = papers.load_paper_table(number)
    assert len(frame) == ROWS[number]
    assert {"model", "window_frames", "metric", "unit", "better", "printed", "value"} <= set(frame)
    dashes = frame["printed"] == ""
    assert (frame["value"].isna() == dashes).all() and not dashes.all()
    assert frame.attrs["table"] == number and "100STYLE" in frame.attrs["setting"]


ACMDM_ROWS = {"1": 75, "2": 70, "3": 108, "4": 28, "A1": 144, "A2": 252, "A3": 42, "A4": 49, "A5": 24}


@pytest.mark.parametrize("number", ACMDM_ROWS)
def test_acmdms_tables_are_whole_and_its_own_rows_have_presets(number):
    frame = papers.load_paper_table(number, "acmdm")
    assert len(frame) == ACMDM_ROWS[number] and "HumanML3D" in frame.attrs["setting"]
    assert set(frame["better"]) <= {"up", "down", "real"}
    assert (frame["value"].isna() == (frame["printed"] == "")).all()
    own = {name for name in frame["model"] if name.startswith("ACMDM")}
    assert own and all(find_preset(name).paper == "acmdm" for name in own)


def test_acmdms_headline_row_is_the_same_in_every_table():
    rows = [("1", "ACMDM-S-PS22 (absolute, AdaLN, causal AE, v)"), ("2", "ACMDM-S-PS22"), ("A1", "ACMDM-S-PS22")]
    for number, model in rows:
        frame = papers.load_paper_table(number, "acmdm")
        row = frame[(frame["model"] == model) & (frame["metric"] == "FID") & (frame.get("cfg", "yes") == "yes")]
        assert row["printed"].tolist() == ["0.109"], number
    with pytest.raises(ValueError, match="Tables 1 to A5, not '7'"):
        papers.load_paper_table("7", "acmdm")


def test_the_headline_row_is_the_same_in_every_table():
    def row(number, model):
        frame = papers.load_paper_table(number)
        chosen = frame[(frame["model"] == model) & (frame["window_frames"] == 32) & (frame["steps"] == 8)]
        shared = chosen[~chosen["metric"].str.startswith("synthesis")]
        return dict(zip(shared["metric"], shared["printed"], strict=True))

    first = row(3, "F3AMD-FNO-96")
    assert first["IRD"] == "1.795" and first["style_coverage"] == "93.980" and len(first) == 9
    for number, model in (
        (5, "F3AMD-FNO-96"),
        (8, "F3AMD-FNO-96"),
        (9, "F3AMD-FNO-96 (FNO enc/dec)"),
        (10, "F3AMD-FNO-96, m=17"),
        (11, "F3AMD-FNO-96 (FiLM)"),
        (12, "F3AMD-FNO-96"),
    ):
        assert row(number, model) == first, number


def test_paper_tables_are_copies_and_end_at_twelve():
    frame = papers.load_paper_table(3)
    frame["value"] = 0.0
    frame.attrs["setting"] = "mine"
    again = papers.load_paper_table(3)
    assert again["value"].abs().sum() > 0 and again.attrs["setting"] == papers.load_paper_file("paper")["setting"]
    refused("Tables 1 to 12, not 13", papers.load_paper_table, 13)


# ------------------------------------------------------------------------------------- tables


def test_markdown_has_units_dashes_and_alignment():
    frame = pd.DataFrame({"model": ["a|b", "c"], "time (ms)": [1234.5678, float("nan")], "printed": ["0.250", ""]})
    lines = tables.markdown_table(frame).splitlines()
    assert len({len(line) for line in lines}) == 1
    cells = [[cell.strip() for cell in line.strip("|").split(" | ")] for line in lines]
    assert cells[0] == ["model", "time (ms)", "printed"]
    assert cells[2] == ["a\\|b", "1235", "0.250"]
    assert cells[3] == ["c", "–", "–"]
    assert lines[1].count(":") == 2  # both number columns flush right


@pytest.mark.parametrize(
    ("value", "text"), [(0.0, "0.000"), (3.26049, "3.260"), (93.98, "93.98"), (1e-5, "1.00e-05"), (-12.5, "-12.50")]
)
def test_numbers_show_four_digits(value, text):
    assert f" {text} |" in tables.markdown_table(pd.DataFrame({"a": [value]}))


def test_a_stored_result_is_shown_with_its_origin(tmp_path, monkeypatch):
    monkeypatch.setattr(stored, "repository_root", lambda: tmp_path)
    assert "No stored `02_any` of `laptop` on `synthetic` yet" in stored.stored_result("synthetic", "02_any")
    told, path = record(), tmp_path / "paper_figures/synthetic/laptop/tables/02_any.csv"
    records.write_table(path, pd.DataFrame({"model": ["a"], "value": [1.23456]}), told)
    shown = stored.stored_result("synthetic", "02_any")
    assert f"data {told['dataset']}, {counted_cores(told)}" in shown and told["date_utc"][:10] in shown
    assert "| a     |  1.23 |" in shown


# ------------------------------------------------------------------------------------- figures


def luminance(color):
    linear = [c / 12.92 if c <= 0.04045 else ((c + 0.055) / 1.055) ** 2.4 for c in to_rgb(color)]
    return float(np.dot(linear, [0.2126, 0.7152, 0.0722]))


def test_colours_stay_apart_in_grey():
    families = ["real", "F3AMD-FNO-96", "CAMDM", "F3AMD-Transformer-64"]
    grey = [luminance(figures.model_style(name).color) for name in families]
    assert np.min(np.diff(grey)) > 0.03 and grey == sorted(grey)
    limbs = [luminance(stick_figures.LIMB_COLORS[side]) for side in ("middle", "right", "left")]
    assert np.min(np.diff(limbs)) > 0.03


def test_model_styles_follow_the_family():
    style = figures.model_style
    assert style("F3AMD-FNO-96 (FiLM)") == style("F3AMD-FNO-96")
    # Our own recipes have a colour each, whatever the width, and never that of a paper's model.
    ours = {style(f"F3AMD-FNO-{width}{end}").color for width in (32, 96) for end in ("-plus", "-steady")}
    assert len(ours) == 2 and not ours & {style(name).color for name in ("F3AMD-FNO-96", "CAMDM")}
    assert style("F3AMD-FNO-96-plus, 1 step").color == style("F3AMD-FNO-96-plus").color
    sizes = [style(f"F3AMD-FNO-{width}") for width in (32, 48, 64, 96, 128)]
    assert len({s.color for s in sizes}) == len({s.marker for s in sizes}) == 5
    assert style("CAMDM-code").color == style("CAMDM").color != style("F3AMD-FNO-96").color


def test_one_step_is_drawn_otherwise_than_eight_and_curves_in_an_order_grow_lighter():
    eight, one = (figures.system_line(f"F3AMD-FNO-96, {steps}") for steps in ("8 steps", "1 step"))
    assert eight == figures.model_style("F3AMD-FNO-96").line
    assert (one["linestyle"], one["markerfacecolor"], one["color"]) == (":", "white", eight["color"])
    lights = [luminance(color[:3]) for color in figures.shades(5)]
    assert len(set(lights)) == 5 and lights == sorted(lights)


def test_style_is_used_and_given_back():
    frame, place = matplotlib.rcParams["legend.frameon"], matplotlib.rcParams["axes.titlelocation"]
    with matplotlib.rc_context():
        figures.use_style()
        assert matplotlib.rcParams["axes.titlelocation"] == "left"
    with figures.plot_style():
        assert matplotlib.rcParams["legend.frameon"] is False
    assert matplotlib.rcParams["legend.frameon"] == frame
    assert matplotlib.rcParams["axes.titlelocation"] == place


def test_saved_figures_depend_on_the_drawing_alone(tmp_path):
    def draw(path):
        figure, axis = figures.new_figure()
        axis.plot([0, 1], [0, 1], **figures.model_style("CAMDM").line)
        return figures.save_figure(figure, path)

    one, two = draw(tmp_path / "a" / "one.png"), draw(tmp_path / "two.png")
    assert one.read_bytes() == two.read_bytes()
    with Image.open(one) as image:
        assert image.size == (770, 396)
        assert not {"Software", "Creation Time", "date"} & set(image.info)
    refused(r"written as \.png", draw, tmp_path / "figure.pdf")


def test_titles_and_labels_of_fixed_aspect_are_not_cut_off(tmp_path):
    """One layout is not enough: it does not know yet how much room a fixed aspect leaves."""
    with figures.plot_style():
        figure, axes = figures.new_figure(8.8, 3.2, 1, 3, sharey=True)
        for axis in axes:
            axis.set(title="title", xlabel="label", aspect="equal", xlim=(-3, 3), ylim=(-3, 3))
    assert not cut_off(figures.save_figure(figure, tmp_path / "fixed.png"))


# ------------------------------------------------------------------------------------- pictures


def test_camera_stands_at_the_right_side():
    """Facing +Z and seen from the right: forward is right on the page, the left hand is far."""
    view = lambda yaw, elevation=0.0: stick_figures.Camera(yaw, elevation).view
    right, up, towards = view(-np.pi / 2)
    np.testing.assert_allclose(right, [0, 0, 1], atol=1e-12)
    np.testing.assert_allclose(up, [0, 1, 0], atol=1e-12)
    np.testing.assert_allclose(towards, [-1, 0, 0], atol=1e-12)
    # From the front, the character's left (+X) is on the viewer's right.
    np.testing.assert_allclose(view(0.0)[0], [1, 0, 0], atol=1e-12)
    for turned in (view(0.3, 0.3), view(-3.0, 0.1)):
        np.testing.assert_allclose(turned @ turned.T, np.eye(3), atol=1e-12)
        assert np.linalg.det(turned) == pytest.approx(1.0)


@pytest.mark.parametrize(
    ("name", "side"),
    [
        ("UpperLeg_L", "left"),
        ("mixamorig:RightFoot", "right"),
        ("LeftToe", "left"),
        ("Chest", "middle"),
        ("Hand_R", "right"),
    ],
)
def test_sides_by_name(name, side):
    assert stick_figures.limb_side(name) == side


def count_near(image, color, tolerance=12):
    pixels = np.asarray(image.convert("RGB"), dtype=int)
    wanted = np.round(255 * np.array(to_rgb(color)))
    return int((np.abs(pixels - wanted).max(axis=-1) <= tolerance).sum())


def test_film_strip_has_a_row_a_motion(tmp_path):
    motion = make_motion()
    figure = pictures.film_strip([motion, motion.slice(0, 60)], paths=[named_path("straight", 120), None], num_poses=5)
    assert len(figure.axes) == 4
    assert figure.axes[0].get_title(loc="left") == "test walk"
    shown = [text.get_text() for text in figure.axes[0].texts]
    assert shown[0] == "1" and "4.0 s" in shown and len(shown) == 10
    low, high = figure.axes[1].get_xlim()
    assert low > high  # +X to the left, as seen from above
    path = figures.save_figure(figure, tmp_path / "strip.png")
    with Image.open(path) as image:
        for side in ("left", "right", "middle"):
            assert count_near(image, stick_figures.LIMB_COLORS[side]) > 200


def test_a_film_strip_shows_whole_limbs_on_one_scale():
    """Arms that are held out before the last pose of a row need more room than other rows do."""
    walk, forward = make_motion(), matrix_from_euler("X", np.array([-90.0]))
    longer = dataclasses.replace(walk.skeleton, offsets=walk.skeleton.offsets * np.array([1.0, 1.8, 1.0]))
    held = walk.rotations.copy()
    held[:, [k for k, name in enumerate(longer.names) if "Shoulder" in name]] = forward
    reaching = walk.replace(skeleton=longer, rotations=held)
    axes = pictures.film_strip([walk, reaching]).axes[::2]
    assert axes[0].get_xlim() == axes[1].get_xlim()
    for axis in axes:
        bodies = [part for part in axis.collections if isinstance(part, LineCollection)]
        across = np.concatenate([np.concatenate(body.get_segments()) for body in bodies])[:, 0]
        assert axis.get_xlim()[0] < across.min() and across.max() < axis.get_xlim()[1]


def test_numbers_of_a_plan_do_not_lie_on_each_other():
    """Somebody who stands has one number; somebody who walks has all."""
    walk = make_motion()
    for still, expected in ((False, 5), (True, 1)):
        root = walk.root_position * ([0.01, 1.0, 0.01] if still else 1.0)
        plan = pictures.film_strip(walk.replace(root_position=root), num_poses=5).axes[1]
        assert len(plan.texts) == expected and plan.texts[0].get_text() == "1"


def test_film_strip_is_written_in_one_call(tmp_path):
    motion = make_motion(30)
    path = pictures.write_film_strip(tmp_path / "new" / "strip.png", motion, num_poses=3)
    other = figures.save_figure(pictures.film_strip(motion, num_poses=3), tmp_path / "other.png")
    assert path.read_bytes() == other.read_bytes()
    refused("strip.jpg: figures are written as .png", pictures.write_film_strip, tmp_path / "strip.jpg", motion)


def test_film_strip_errors():
    refused("frames 0 to 119; asked for 0 to 500", pictures.film_strip, make_motion(), frames=[0, 500])
    refused("2 titles for 1 motions", pictures.film_strip, make_motion(), titles=["a", "b"])
    refused("needs a Motion", pictures.film_strip, [])
    refused("num_poses", pictures.film_strip, make_motion(), num_poses=0)


def test_gif_plays_in_real_time_and_stays_small(tmp_path):
    motion = make_motion(240)
    path = pictures.write_gif(tmp_path / "deep" / "walk.gif", motion, target_paths=named_path("slalom", 240))
    assert path.stat().st_size < 300_000
    with Image.open(path) as image:
        assert image.n_frames == 80 and image.size == (256, 256) and image.info["loop"] == 0
        total = 0
        for frame in range(image.n_frames):
            image.seek(frame)
            total += image.info["duration"]
        assert total == 8000 + 600  # 8 s and a pause
        image.seek(40)
        for side in ("left", "right"):
            assert count_near(image, stick_figures.LIMB_COLORS[side], tolerance=25) > 100


def test_gif_follows_the_character(tmp_path):
    """After 9 m of walking the figure is still in the middle of the picture."""
    path = pictures.write_gif(tmp_path / "walk.gif", make_motion(240))
    with Image.open(path) as image:
        image.seek(79)
        pixels = np.asarray(image.convert("RGB"), dtype=int)
    dark = np.argwhere(pixels.max(axis=-1) < 90)[:, 1]
    assert abs(np.median(dark) - 128) < 20


def test_gif_of_several_motions_and_its_limits(tmp_path):
    motions = [make_motion(60), make_motion(90)]
    path = pictures.write_gif(tmp_path / "two.gif", motions, size=(120, 140), max_seconds=2.0)
    with Image.open(path) as image:
        assert image.size == (240, 140) and image.n_frames == 20
    with pytest.raises(ValueError, match=r"60 frames a second are too many .* every to 2"):
        pictures.write_gif(tmp_path / "fast.gif", make_motion(fps=60.0), every=1)
    refused("one frame rate", pictures.write_gif, tmp_path / "x.gif", [make_motion(), make_motion(fps=60.0)])
    refused(r"written as \.gif", pictures.write_gif, tmp_path / "x.mp4", make_motion())
