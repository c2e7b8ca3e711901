"""The road from a preset's name to a trained model of captioned motion, stage by stage.

    ACMDM      captioned clips -> positions -> (autoencoder -> latent) -> denoiser -> (control branch)
    MotionPCM  captioned clips -> autoencoder -> latents -> teacher -> student

Each stage leaves one file that is whole in itself, with the weights of the stages before it. `STAGES` has them all.
"""

from f3amd_lib.ground.names import refuse_unknown
from f3amd_lib.ground.papers import load_paper_file
from f3amd_lib.ground.profiles import Profile, load_profile
from f3amd_lib.ground.records import read_table, run_record
from f3amd_lib.networks import presets
from f3amd_lib.networks.presets import Preset
from f3amd_lib.text.data.redundant import NUM_JOINT_FEATURES
from f3amd_lib.text.data.text_encoders import TextEncoder
from f3amd_lib.text.data.text_motions import UNIT, AxisNormaliser, TextMotions
from f3amd_lib.text.stages import acmdm_training, motionpcm_training, text_models
from f3amd_lib.text.stages.text_models import LatentModel, MotionCodec, TextModel, load_text_model, preset_and_branch
from f3amd_lib.training.optimise import differences
from f3amd_lib.training.pipeline import alone_with, train_in_legs

STAGES = {
    "motion autoencoder": acmdm_training.AutoencoderTask,
    "mesh autoencoder": acmdm_training.MeshAutoencoderTask,
    "ACMDM": acmdm_training.TextMotionTask,
    "masked ACMDM": acmdm_training.TextMotionTask,
    "control branch": acmdm_training.ControlTask,
    "latent autoencoder": motionpcm_training.LatentAutoencoderTask,
    "latent denoiser": motionpcm_training.TeacherTask,
    "student": motionpcm_training.DistillationTask,
}
"""What trains each stage, which is called as the family of its network or as what stands on such a one: a class with

- `settings` and `recipe`, the class of its settings and their name in `papers/<paper>/recipes.toml`;
- `of(asked, split)`, the task on the clips of a split;
- `held_out()` of a task, a batch to watch the losses on;
- `kept(asked, state, about)` of a task, what is kept of its last state.
"""


def stage_of(name: str) -> str:
    """Return the stage of `STAGES` that trains a preset, with or without a branch; ValueError for others' presets."""
    base, branch = preset_and_branch(name)
    preset = presets.find_preset(base)
    if preset.family not in STAGES:
        raise ValueError(f"{name} needs no captions: train it in a separate call")
    return "control branch" if branch else "student" if preset.network.get("guidance_features") else preset.family


def stands_on(name: str) -> str:
    """Return the preset that is trained before this one: its autoencoder, a student's teacher, a branch's denoiser."""
    base, branch = preset_and_branch(name)
    preset = presets.find_preset(base)
    if branch:
        return preset.name
    if stage_of(name) != "student":
        return preset.latent
    fits = lambda other: other.latent == preset.latent and stage_of(other.name) == "latent denoiser"
    return next(name for name, other in presets.PRESETS.items() if fits(other))


def _codec_of_positions(data: TextMotions, preset: Preset) -> MotionCodec:
    """Return the codec of positions, and of redundant features beside them where a preset has channels for those."""
    redundancy = None
    if preset.network.get("channels") == 3 + NUM_JOINT_FEATURES:
        redundancy = AxisNormaliser.of(data.select(data.members("train")).joint_features())
    return MotionCodec(data.normaliser(), redundancy=redundancy)


def stage_recipe(training: type, part: str, profile: Profile, preset: str | None = None, **settings):
    """Return how a profile trains a stage: by the paper's recipe on `gpu`, by the short one and its share elsewhere.

    Where the profile's number of steps is the usual one, a recipe's own goes before it.

    Args:
      training: class of the settings; its `paper` names the folder of the recipes.
      part: a name of `papers/<paper>/recipes.toml`, such as "denoiser", which has "short-denoiser" beside it.
      profile: says how long and from which seed.
      preset: adds what its own training says (`presets.find_preset`).
      **settings: fields to change.

    Raises:
      ValueError: for an unknown preset or field, with the nearest name.
    """
    recipe = load_paper_file("recipes", training.paper)[part if profile.name == "gpu" else f"short-{part}"]
    num_steps, usual = profile.train_steps, load_profile(profile.name, profile.dataset).train_steps
    if num_steps == usual:
        num_steps = recipe.get("num_steps", num_steps)
    own = {} if preset is None else presets.find_preset(preset).training
    values = {**recipe["training"], **own, **settings, "seed": profile.seed}
    refuse_unknown(values, training, "training setting")
    return training(max(1, round(recipe.get("share", 1.0) * num_steps)), **values)


def _check_heard(file, text_encoder: str | None, encoder: TextEncoder) -> None:
    """Raise ValueError if a file's captions were embedded by another encoder, where it names one."""
    if text_encoder and text_encoder != encoder.identity:
        what = f"its captions were embedded by {text_encoder}, not by {encoder.identity}"
        raise ValueError(f"{file}: {what}; move it away or name another folder (--out)")


def train_stage(
    data: TextMotions, encoder: TextEncoder, profile: Profile, name: str, *,
    window: int | None = None, batch_size: int | None = None, learning_rate: float | None = None, folder=None,
    teacher=None, **leg,
) -> TextModel | LatentModel | None:  # fmt: skip
    """Train a preset, and first what it stands on, unless that is finished already; of ACMDM with whatever settings.

    A branch may stand beside the network that ships, where that knows these motions. A killed training goes on where it
    was; a finished model is only read.

    Args:
      data: captioned clips.
      encoder: of the captions.
      profile: how long, each stage its recipe's share of it; "gpu" by the paper's recipe, else by the short ones.
      name: of a preset of ACMDM, perhaps with "+control" or "+control-pelvis" behind it, or of MotionPCM.
      window: of ACMDM, most frames of motion in a state, instead of the preset's; longer clips are cut to their first
        frames, so that all begin where a caption's motion will: at the origin.
      batch_size, learning_rate: instead of the recipe's.
      folder: where files go instead of `runs/`.
      teacher: model, or file of one, that holds what it stands on, such as a shipped teacher, instead of training it.
      **leg: stop_at and progress, as for `optimise`.

    Returns:
      The model as its file has it; None where `stop_at` came first.

    Raises:
      ValueError: if a model or a state of other settings lies there, or what it stands on is another or of other data.
      TrainingDiverged: if the loss stops being a number.
    """
    base, branch = preset_and_branch(name)
    preset, stage, earlier = presets.find_preset(base), STAGES[stage_of(name)], stands_on(name)
    if branch and preset.latent and stage_of(preset.latent) == "mesh autoencoder":
        raise ValueError(f"{preset.name} has no control branch: its states are of vertices, not of joints")
    name, acmdm = preset.name + branch, stage.settings is acmdm_training.TextMotionTraining
    data = data.cut(window) if acmdm and window and window < data.lengths.max() else data
    before = teacher if teacher is None or isinstance(teacher, TextModel | LatentModel) else load_text_model(teacher)
    if before is not None:
        if earlier not in {before.name, presets.find_preset(preset_and_branch(before.name)[0]).latent} - {""}:
            raise ValueError(f"{teacher}: holds {before.name}, and {name} needs {earlier or 'no earlier model'}")
        if not before.record["identity"]["dataset_fingerprint"].startswith(data.fingerprint):
            raise ValueError(f"{teacher}: was trained on other clips than these; leave --teacher out to train one")
        _check_heard(teacher, before.text_encoder, encoder)
    elif earlier:
        lies = text_models.text_model_files(profile, earlier, folder=folder).model
        if acmdm and lies.exists():
            before = load_text_model(lies)
        elif branch:
            before = text_models.shipped_for(earlier, data, encoder)
        how = {"window": window, "batch_size": batch_size, "folder": folder, **leg}
        before = before or train_stage(data, encoder, profile, earlier, **how)
        if before is None:
            return None
        if acmdm and before.record["dataset_fingerprint"] != data.fingerprint:
            raise ValueError(f"{lies}: was trained on other data; move it away or name another folder (--out)")
    settings, codec = {"batch_size": batch_size, "learning_rate": learning_rate}, None
    settings = {name: value for name, value in settings.items() if value is not None}
    if acmdm:
        codec = _codec_of_positions(data, preset) if before is None else before.codec
        settings["unit"] = max(1, UNIT // codec.frames_per_state)
    config = stage_recipe(stage.settings, stage.recipe, profile, None if branch else preset.name, **settings)
    files = text_models.text_model_files(profile, name, folder=folder)
    asked = text_models.Asked(data, encoder, preset, branch, config, before, codec, window)
    if files.model.exists():
        found = load_text_model(files.model)
        if unlike := differences(stage.of(asked, None).identity(), found.record["identity"]):
            lies = f"a model with other {'; '.join(unlike)} lies there"
            raise ValueError(f"{files.model}: {lies}; move it away or name another folder (--out)")
        _check_heard(files.model, found.text_encoder, encoder)
        return found
    if files.state.exists() and files.history.exists():
        _check_heard(files.state, read_table(files.history)[1].get("text_encoder"), encoder)
    task, held_out = stage.of(asked, "train"), stage.of(asked, "validation").held_out()
    told = {"model": name, "identity": task.identity(), "num_train_clips": len(data.members("train"))}
    told["text_encoder"] = encoder.identity
    record = run_record(profile=profile, dataset=data, seed=config.seed, **told)
    with alone_with(files):
        state, _ = train_in_legs(task, files, record, held_out=held_out, **leg)
    if int(state.step) < config.num_steps:
        return None
    about = {"name": name, "skeleton": data.skeleton, "fps": data.fps, "record": record}
    text_models.save_text_model(files.model, task.kept(asked, state, about))
    return load_text_model(files.model)
