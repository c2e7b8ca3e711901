"""Training of MotionPCM: what each task asks, who learns from what, and a toy on which a student does learn."""

import functools

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from builders import refused, same_tree
from compiled import Compiled
from flax import nnx

from f3amd_lib.diffusion.schedules import variance_preserving_betas
from f3amd_lib.motion import synthetic
from f3amd_lib.motion.skeleton import resample
from f3amd_lib.networks.presets import build_from_config
from f3amd_lib.text.data.redundant import grouped_statistics
from f3amd_lib.text.data.text_motions import AxisNormaliser, text_motions
from f3amd_lib.text.networks.motionpcm import (
    DiscriminatorConfig,
    LatentAutoencoderConfig,
    LatentDenoiserConfig,
    student_of,
)
from f3amd_lib.text.phases import jump, latent_consistency_end, shares
from f3amd_lib.text.sampling.motionpcm_sampling import (
    sample_latent_student,
    sample_student,
    sample_teacher,
    teacher_prediction,
)
from f3amd_lib.text.stages import motionpcm_training as training
from f3amd_lib.training.checkpoints import network_with
from f3amd_lib.training.optimise import advance, initial_state, restore_state, save_state

SCHEDULE = variance_preserving_betas()
SMALL = {"latent_width": 16, "depth": 3, "num_heads": 2, "hidden_width": 32, "dropout": 0.0}
TEACHER = LatentDenoiserConfig(**SMALL, window=2, channels=3, text_width=4, time_features=16)


def normal(seed, *shape):
    return jax.random.normal(jax.random.key(seed), shape)


def latents(**changes):
    """Five clips with one caption or two, and the empty one."""
    count = jnp.asarray([1, 2, 1, 2, 1])
    table = training.LatentTable(
        normal(0, 5, 2, 3), jnp.full((5, 2, 3), -20.0), jnp.cumsum(count) - count, count, normal(1, 7, 4), normal(2, 4)
    )
    return table._replace(**changes)


def recipe(**settings):
    return training.LatentMotionTraining(**{"num_steps": 4, "batch_size": 8, "warmup_steps": 0, "seed": 0, **settings})


@functools.cache
def teacher_weights():
    return nnx.state(build_from_config(TEACHER, jax.random.key(5)))


def distillation(**settings):
    config = recipe(**{"ema_decay": 0.95, "num_phases": 2, **settings})
    return training.DistillationTask(TEACHER, config, latents(), SCHEDULE, teacher_weights())


@functools.cache
def usual_task():
    return distillation()


@pytest.fixture(scope="module")
def start():
    return initial_state(usual_task())


@pytest.fixture(scope="module")
def batch(start):
    drawn = jax.jit(lambda state: usual_task().draw(state, jax.random.key(4)))(start)[0]
    assert set(np.asarray(drawn.edge)) == {0, 499}  # of both phases
    return drawn


# ------------------------------------------------------------------------------------------------------------- recipes


def test_recipes_that_make_no_sense_are_refused():
    for settings, message in (
        ({"consistency": "phase"}, "did you mean 'phased'"),
        ({"consistency": "latent"}, "needs num_phases 1"),
        ({"batch_size": 0}, "batch_size"), ({"least_guidance": 16.0}, "least_guidance"),
    ):  # fmt: skip
        refused(message, recipe, **settings)
    refused("set ema_decay", training.DistillationTask, TEACHER, recipe(), latents(), SCHEDULE, teacher_weights())


# --------------------------------------------------------------------------------------------------------- autoencoder


def test_an_error_is_a_mean_over_numbers_then_frames_then_clips():
    made, mask = jnp.zeros((2, 4, 3)), jnp.arange(4) < jnp.asarray([[4], [1]])
    true = made.at[0].set(2.0).at[1, 0].set(0.5).at[1, 1:].set(1e3)
    # 1.5 and 0.125; padding does not count, and a short clip counts as much as a long one.
    assert training.clip_error(made, true, mask) == pytest.approx((1.5 + 0.125) / 2)
    assert training.clip_error(made, made, mask) == 0.0


def test_a_latent_is_drawn_from_its_gaussian_and_diverges_from_the_standard_one():
    joints, frames = 2, 4

    class Coder:
        mean, deviation = 1.0, 2.0

        def encode(self, features, mask, key=None):
            ones = jnp.ones((len(features), 2, 3))
            return self.mean * ones, 2.0 * np.log(self.deviation) * ones

        def decode(self, latent, mask, key=None):
            return jnp.zeros((*mask.shape, 12 * joints - 1))

    statistics = AxisNormaliser(jnp.zeros(23), jnp.full(23, 0.1))
    clips = normal(0, 2, frames, 12 * joints - 1), jnp.ones((2, frames), bool)
    terms = training.reconstruction_terms(Coder(), statistics, *clips)
    # KL(N(1, 4) | N(0, 1)) of each number.
    assert float(terms["divergence"]) == pytest.approx(0.5 * (1 + 4 - 1 - np.log(4)), rel=1e-5)
    standard = Coder()
    standard.mean, standard.deviation = 0.0, 1.0
    assert float(training.reconstruction_terms(standard, statistics, *clips)["divergence"]) == 0.0
    drawn = training.draw_latent(jax.random.key(0), jnp.full(100_000, 1.0), jnp.full(100_000, 2.0 * np.log(2.0)))
    assert (float(drawn.mean()), float(drawn.std())) == pytest.approx((1.0, 2.0), abs=0.03)


# ------------------------------------------------------------------------------------------------------------- teacher


def test_a_clips_captions_are_its_own_and_some_are_the_empty_one():
    numbers = jnp.arange(5.0)[:, None, None] * jnp.ones((1, 2, 3))
    marked = latents(mean=numbers, pooled=jnp.arange(7.0)[:, None].repeat(4, 1), empty=jnp.full(4, -1.0))
    task = training.TeacherTask(TEACHER, recipe(batch_size=512, text_dropout=0.25), marked, SCHEDULE)
    (latent, text), _ = task.draw(None, jax.random.key(0))
    owner, caption = (np.rint(np.asarray(column)).astype(int) for column in (latent[:, 0, 0], text[:, 0]))
    assert np.mean(caption == -1) == pytest.approx(0.25, abs=0.06)
    clip_of = np.array([0, 1, 1, 2, 3, 3, 4])
    told = caption >= 0
    np.testing.assert_array_equal(clip_of[caption[told]], owner[told])
    assert set(caption) == {-1, *range(7)}


class Looking:
    """A network that writes down what it is asked, and answers 0."""

    def __init__(self):
        self.asked = []

    def encode(self, text):
        return text

    def __call__(self, state, time, context, *guidance, key=None):
        self.asked.append((state, time, context, *guidance))
        return jnp.zeros_like(state)


def test_a_teacher_is_asked_for_the_noise_at_the_level_that_it_is_told(monkeypatch):
    network = Looking()
    monkeypatch.setattr(training, "network_with", lambda config, params: network)
    task = training.TeacherTask(TEACHER, recipe(), latents(), SCHEDULE)
    clean, text = normal(3, 512, 2, 3), normal(4, 512, 4)
    loss, (terms, _) = task.loss({}, None, (clean, text), jax.random.key(2))
    ((state, time, context),) = network.asked
    np.testing.assert_array_equal(context, text)
    # Levels come from all over the schedule, and each sample has the noise of its own.
    assert np.min(time) < 20 and np.max(time) > 980 and np.mean(time) == pytest.approx(500, abs=60)
    alpha, sigma = (np.asarray(share).reshape(-1, 1, 1) for share in shares(SCHEDULE, time))
    late = np.asarray(time) > 20
    noise = ((np.asarray(state) - alpha * clean) / sigma)[late]
    assert noise.std() == pytest.approx(1.0, abs=0.05) and abs(noise.mean()) < 0.05
    assert abs(np.corrcoef(noise.ravel(), np.asarray(clean)[late].ravel())[0, 1]) < 0.05
    # Who answers 0 errs by the noise itself.
    assert float(loss) == pytest.approx(1.0, abs=0.08) and terms["loss"] == loss


def test_a_table_has_each_clips_latent_beside_its_captions():
    clips = []
    for number, (split, said) in enumerate((("train", 1), ("test", 2), ("train", 1))):
        motion = resample(synthetic.synthesize(synthetic.STYLES[number], seconds=2.0, seed=number), 20.0).slice(0, 40)
        clips.append((f"clip {number}", motion, tuple(f"{number} {k}" for k in range(said)), split, "walk"))
    data = text_motions(clips, skeleton=motion.skeleton, name="three", fps=20.0, licence="", credit="")
    # Of the training clips alone, however the other one moves.
    statistics = training.frame_statistics(data)
    known = np.concatenate([data.select([number]).redundant_vectors() for number in (0, 2)])
    np.testing.assert_allclose(statistics.mean, grouped_statistics(known)[0], atol=1e-6)
    assert np.abs(statistics.mean - grouped_statistics(data.redundant_vectors())[0]).max() > 1e-3

    class Coder(nnx.Module):
        config = LatentAutoencoderConfig(released_facing=True)

        def encode(self, features, mask):
            return (features * mask[..., None]).sum(axis=1, keepdims=True), features[:, :1] + 1.0

    pooled, empty = normal(0, 4, 5), normal(1, 5)
    made = training.latent_table(Coder(), statistics, data, pooled, empty, num_frames=36, batch=2)
    assert (made.caption.tolist(), made.count.tolist()) == ([0, 1, 3], [1, 2, 1])
    np.testing.assert_array_equal(made.pooled, pooled)
    np.testing.assert_array_equal(made.empty, empty)
    for number in range(3):
        features = statistics.normalise(data.select([number]).redundant_vectors())
        np.testing.assert_allclose(made.mean[number, 0], features[:36].sum(axis=0), rtol=1e-3, atol=1e-2)
        np.testing.assert_allclose(made.log_variance[number, 0], features[0] + 1.0, atol=1e-4)


# -------------------------------------------------------------------------------------------------------- distillation


def test_a_student_begins_as_its_teacher(start):
    teacher = network_with(TEACHER, teacher_weights())
    student = network_with(usual_task().student_config, start.params["student"])
    state, text, time = normal(1, 3, 2, 3), normal(2, 3, 4), jnp.asarray([999, 499, 99])
    told = student(state, time, student.encode(text), jnp.asarray([5.0, 10.0, 15.0]))
    np.testing.assert_allclose(told, teacher(state, time, teacher.encode(text)), atol=1e-6)


def test_the_target_is_the_moving_average(start):
    """Other weights of the student change nothing of what it is asked; another average changes the target."""
    moved = jax.tree.map(lambda leaf: 1.1 * leaf, start.params)
    draw = jax.jit(lambda state: usual_task().draw(state, jax.random.key(3))[0].target)
    target = draw(start)
    np.testing.assert_array_equal(draw(start._replace(params=moved)), target)
    assert np.abs(draw(start._replace(ema=moved)) - target).max() > 1e-3


def test_each_sample_is_told_its_own_guidance_and_jumps_to_its_own_edge(batch, monkeypatch):
    network = Looking()
    monkeypatch.setattr(training, "network_with", lambda config, params: network)
    task, batch = distillation(adversarial_weight=0.0), batch._replace(edge=10 * jnp.arange(8))
    loss, _ = task.loss({"student": {}}, None, batch, None)
    for seen, wanted in zip(network.asked[0], (batch.state, batch.time, batch.text, batch.guidance), strict=True):
        np.testing.assert_array_equal(seen, wanted)
    assert len(set(np.asarray(batch.guidance).tolist())) == 8
    asked = zip(batch.state, batch.time, batch.edge, strict=True)
    end = [jump(SCHEDULE, z[None], 0 * z[None], t, s)[0] for z, t, s in asked]
    wanted = np.sqrt((np.stack(end) - batch.target) ** 2 + 0.25) - 0.5
    assert float(loss) == pytest.approx(float(wanted.mean()), rel=1e-4)


def test_what_is_asked_lies_in_its_phase(batch, start):
    questions = lambda key: usual_task().questions(start.ema["student"], *usual_task().clips.draw(key, 256), key)
    drawn = jax.jit(questions)(jax.random.key(1))
    phases, edge = usual_task().phases, np.asarray(drawn.edge)
    assert set(np.asarray(drawn.time)) == set(phases.times) and set(edge) == {0, 499}
    end = np.where(edge == 0, 499, 999)
    for time in (drawn.time, drawn.critic_time):
        assert ((edge <= time) & (time <= end)).all()
    assert (5 <= drawn.guidance).all() and (drawn.guidance <= 15).all() and drawn.guidance.std() > 2
    # Data come to the discriminator with noise of their own: at s they fit the marginal, and not the student's noise.
    alpha, sigma = (share.reshape(-1, 1, 1) for share in shares(SCHEDULE, drawn.time))
    clean = usual_task().clips.draw(jax.random.key(1), 256)[0]
    noise = (drawn.state - alpha * clean) / sigma
    alpha, sigma = (share.reshape(-1, 1, 1) for share in shares(SCHEDULE, drawn.critic_time))
    critics = np.asarray((drawn.real - alpha * clean) / sigma)
    late = np.asarray(drawn.critic_time) > 100
    assert critics[late].std() == pytest.approx(1.0, abs=0.1) and noise.std() == pytest.approx(1.0, abs=0.1)
    assert abs(np.corrcoef(critics[late].ravel(), np.asarray(noise)[late].ravel())[0, 1]) < 0.1


def test_a_target_is_the_guided_teachers_step_and_then_the_targets_jump(start):
    """Algorithm 1, lines 9 and 10, worked out again point by point, with another target than the student."""
    target = jax.tree.map(lambda leaf: 1.1 * leaf, start.params["student"])
    latent, text = usual_task().clips.draw(jax.random.key(1), 6)
    drawn = jax.jit(usual_task().questions)(target, latent, text, jax.random.key(4))
    teacher = Compiled(network_with(TEACHER, teacher_weights()))
    follower = Compiled(network_with(usual_task().student_config, target))
    for row in range(6):
        one = functools.partial(jax.lax.dynamic_slice_in_dim, start_index=row, slice_size=1)
        state, time, w = one(drawn.state), int(drawn.time[row]), float(drawn.guidance[row])
        told, free = (teacher(state, time, teacher.encode(t)) for t in (one(text), usual_task().clips.empty[None]))
        before = max(time - 100, 0)
        solved = jump(SCHEDULE, state, (1 + w) * told - w * free, time, before)
        answer = follower(solved, before, follower.encode(one(text)), jnp.asarray([w]))
        edge = int(drawn.edge[row])
        wanted = solved if before <= edge else jump(SCHEDULE, solved, answer, before, edge)
        np.testing.assert_allclose(one(drawn.target), wanted, rtol=2e-3, atol=2e-3)


def test_the_critic_sees_the_students_end_carried_to_its_time_and_the_data_through_the_teacher(batch, monkeypatch):
    """Algorithm 1, lines 11, 12 and 15: what is shown, at which time, under which caption, in which order."""
    read = []

    class Reading(Looking):
        def __init__(self, params):
            super().__init__()
            self.params = params

        def features(self, state, time, context):
            read.append((self.params, state, time, context))
            return [state]

    silent = lambda features: jnp.zeros(len(features[0]))
    made = lambda config, params: silent if isinstance(config, DiscriminatorConfig) else Reading(params)
    monkeypatch.setattr(training, "network_with", made)
    loss, (terms, _) = usual_task().loss({"student": {}, "discriminator": {}}, None, batch, None)
    # A student that answers 0 jumps along its own state; from there fresh noise carries it.
    alpha, edge, there = (np.asarray(shares(SCHEDULE, t)[0]).reshape(-1, 1, 1)
                          for t in (batch.time, batch.edge, batch.critic_time))  # fmt: skip
    kept = there / edge
    fake = kept * (edge / alpha * batch.state) + np.sqrt(np.maximum(1 - kept**2, 0)) * batch.fresh
    assert len(read) == 3  # the student's own, the data, the same made thing once more
    for (params, state, time, context), wanted in zip(read, (fake, batch.real, fake), strict=True):
        assert params is teacher_weights()
        np.testing.assert_allclose(state, wanted, atol=1e-4)
        np.testing.assert_array_equal(time, batch.critic_time)
        np.testing.assert_array_equal(context, batch.text)
    # Scores of 0: 1 for the student, 2 for the heads.
    assert (float(terms["adversarial"]), float(terms["discriminator"])) == (1.0, 2.0)
    assert float(loss) == pytest.approx(float(terms["consistency"]) + 0.1 + 2.0)


def test_each_player_follows_its_own_loss(batch, monkeypatch):
    """With a number for each player's weights: the student's answer is that share of its state, a score a sum."""

    class Player(Looking):
        def __init__(self, share):
            self.share = share

        def __call__(self, state, *_):
            return self.share * state

        def features(self, state, *_):
            return state

    def made(config, share):
        critic = isinstance(config, DiscriminatorConfig)
        return (lambda seen: share * seen.sum(axis=(1, 2))) if critic else Player(share)

    monkeypatch.setattr(training, "network_with", made)

    def terms(params):
        loss, (terms, _) = usual_task().loss(params, None, batch, None)
        return {**terms, "sum": loss}

    params = {"student": jnp.asarray(0.1), "discriminator": jnp.asarray(1e-3)}
    slopes, before = jax.jacrev(terms)(params), terms(params)
    assert slopes["discriminator"]["student"] == slopes["adversarial"]["discriminator"] == 0.0
    # What the student follows is the sum of MotionPCM Eq. 14, its second term with weight 0.1; heads know no weight.
    parts = slopes["consistency"]["student"], slopes["adversarial"]["student"]
    assert 0.0 not in parts and float(slopes["sum"]["student"]) == pytest.approx(float(parts[0] + 0.1 * parts[1]))
    assert slopes["sum"]["discriminator"] == slopes["discriminator"]["discriminator"] != 0.0
    # No score is beyond a margin: the student's loss is 1 less the score of what it made, the heads' 2 more that less
    # the data's.
    data = 1e-3 * float(batch.real.sum(axis=(1, 2)).mean())
    assert float(before["discriminator"]) == pytest.approx(3.0 - float(before["adversarial"]) - data, abs=1e-5)


def test_the_critic_looks_from_end_to_end_of_phases_that_are_not_of_one_length(monkeypatch):
    monkeypatch.setattr(training, "network_with", lambda config, params: Looking())
    clips = jnp.zeros((20_000, 1, 1)), jnp.zeros((20_000, 4))
    drawn = distillation(num_phases=4).questions({}, *clips, jax.random.key(2))
    seen = {int(edge): np.asarray(drawn.critic_time[drawn.edge == edge]) for edge in np.unique(drawn.edge)}
    ends = {0: (0, 199), 199: (199, 499), 499: (499, 699), 699: (699, 999)}
    assert {edge: (times.min(), times.max()) for edge, times in seen.items()} == ends
    for edge, times in seen.items():
        assert times.mean() == pytest.approx((times.min() + times.max()) / 2, abs=6), edge


@pytest.mark.slow
def test_the_loop_keeps_the_target_and_trains_both_and_resumes(start, tmp_path):
    assert same_tree(start.params, start.ema)
    keep = jax.tree.map(jnp.copy, start)
    state, terms = advance(usual_task(), jax.tree.map(jnp.copy, start), 1)
    follow_up = jax.tree.map(lambda old, new: 0.95 * old + 0.05 * new, keep.ema, state.params)
    for found, wanted in zip(jax.tree.leaves(state.ema), jax.tree.leaves(follow_up), strict=True):
        np.testing.assert_allclose(found, wanted, atol=1e-7)
    for branch in ("student", "discriminator"):
        changed = jax.tree.map(lambda a, b: float(np.abs(a - b).max()), state.params[branch], keep.params[branch])
        assert max(jax.tree.leaves(changed)) > 1e-5, branch
    assert set(terms) == {"loss", "consistency", "adversarial", "discriminator"}
    save_state(tmp_path / "student", usual_task(), state)
    again = restore_state(tmp_path / "student", usual_task())
    assert same_tree(again.params, state.params)
    refused(r"training settings \(skip\)", restore_state, tmp_path / "student", distillation(skip=50))


@pytest.mark.slow
def test_players_may_learn_by_turns(start):
    task = distillation(alternate=True, warmup_steps=1)
    state = initial_state(task)
    for learner in ("discriminator", "student", "discriminator"):
        before = jax.tree.map(jnp.copy, state.params)
        state, _ = advance(task, state, 1)
        assert [name for name in before if not same_tree(before[name], state.params[name])] == [learner]


@pytest.mark.slow
def test_latent_consistency_is_distilled_without_phases():
    task = distillation(consistency="latent", num_phases=1, adversarial_weight=0.0)
    state = initial_state(task)
    assert set(state.params) == {"student"}
    drawn = jax.jit(task.questions)(state.ema["student"], *task.clips.draw(jax.random.key(1), 8), jax.random.key(4))
    assert not drawn.edge.any()
    loss, (terms, _) = jax.jit(task.loss)(state.params, None, drawn, None)
    student = Compiled(network_with(task.student_config, state.params["student"]))
    eps = student(drawn.state, drawn.time, student.encode(drawn.text), drawn.guidance)
    end = latent_consistency_end(SCHEDULE, drawn.state, eps, drawn.time)
    wanted = np.sqrt((end - drawn.target) ** 2 + 0.25) - 0.5
    assert loss == pytest.approx(float(wanted.mean()), rel=1e-4) and set(terms) == {"loss", "consistency"}


# ------------------------------------------------------------------------------------------------------------ sampling


@pytest.mark.slow
def test_samples_are_calls_of_the_network_at_the_papers_times():
    student = student_of(network_with(TEACHER, teacher_weights()), jax.random.key(0))
    student.guidance.kernel[...] = 0.1 * normal(3, *student.guidance.kernel.shape)
    student = Compiled(student)
    text, noise, empty = normal(1, 3, 4), normal(2, 3, 2, 3), normal(4, 4)
    context, told = student.encode(text), jnp.full(3, 14.0)
    state = noise
    for time, edge in ((999, 499), (499, 0)):
        state = jump(SCHEDULE, state, student(state, time, context, told), time, edge)
    made = sample_student(student, SCHEDULE, text, noise, num_steps=2)
    np.testing.assert_allclose(made, state, atol=1e-4)
    assert np.abs(sample_student(student, SCHEDULE, text, noise, num_steps=2, guidance=5.0) - made).max() > 1e-3
    teacher = Compiled(network_with(TEACHER, teacher_weights()))
    ask = lambda text: teacher(noise, 999, teacher.encode(text))
    wanted = jump(SCHEDULE, noise, 7.5 * ask(text) - 6.5 * ask(jnp.stack([empty] * 3)), 999, 0)
    guided = sample_teacher(teacher, SCHEDULE, text, empty, noise, num_steps=1)
    np.testing.assert_allclose(guided, wanted, rtol=1e-3, atol=1e-3)
    plain = teacher_prediction(teacher, text, empty, 0.0)(noise, 999)
    np.testing.assert_allclose(plain, ask(text), atol=1e-6)
    # The teacher's leading rule asks what is left of noise at the lowest level.
    leading = sample_teacher(teacher, SCHEDULE, text, empty, noise, num_steps=1, guidance=0.0, spacing="leading")
    np.testing.assert_allclose(leading, jump(SCHEDULE, noise, teacher(noise, 1, teacher.encode(text)), 1, 0), atol=1e-4)
    one = sample_latent_student(student, SCHEDULE, text, noise, jax.random.key(1), guidance=7.0)
    asked = student(noise, 799, context, jnp.full(3, 7.0))
    np.testing.assert_allclose(one, latent_consistency_end(SCHEDULE, noise, asked, 799), atol=1e-4)
