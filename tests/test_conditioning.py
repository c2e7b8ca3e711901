"""Condition tokens, cross-attention and FiLM against plain numpy (sections 3.3, 3.4.3)."""

import jax
import jax.numpy as jnp
import numpy as np
import pytest
from flax import nnx

from f3amd_lib.models import conditioning
from f3amd_lib.models.conditioning import (
    Condition,
    ConditionEncoder,
    FiLM,
    noise_features,
    position_code,
)

CHANNELS, STYLES, WIDTH, WINDOW, HISTORY = 9, 3, 8, 6, 4


def draw(*shape, seed=0):
    return np.random.default_rng(seed).standard_normal(shape).astype(np.float32)


def silu(x):
    return x / (1.0 + np.exp(-x))


def make_condition(batch=2, seed=0):
    return Condition(
        history=draw(batch, HISTORY, CHANNELS, seed=seed),
        path=draw(batch, WINDOW, 8, seed=seed + 1),
        style=np.eye(STYLES, dtype=np.float32)[np.arange(batch) % STYLES],
    )


def make_encoder(num_heads=1):
    return ConditionEncoder(
        CHANNELS, STYLES, WIDTH, WINDOW, HISTORY, num_heads, rngs=nnx.Rngs(params=0)
    )


def test_eq01_noise_features_by_hand():
    # log(1) = 0: only the fixed phases remain, whatever the frequencies.
    at_one = np.asarray(noise_features(jnp.float32(1.0), 4096))
    assert at_one.shape == (4096,)
    assert at_one.mean() == pytest.approx(0.0, abs=0.1)
    assert at_one.var() == pytest.approx(1.0, abs=0.1)
    # phi(a) . phi(b) / width is a Gaussian in the distance of log(sigma) / 4, in turns.
    one, two = noise_features(jnp.array([1.0, np.exp(4 * 0.2)]), 4096)
    assert float(one @ two) / 4096 == pytest.approx(np.exp(-2 * (np.pi * 0.2) ** 2), abs=0.06)


def test_eq01_noise_features_tell_levels_apart_and_never_change():
    sigma = jnp.array([128.0, 18.1, 1.0, 0.1, 0.01])
    features = noise_features(sigma, 16)
    assert features.shape == (5, 16) and features.dtype == jnp.float32
    np.testing.assert_array_equal(features, noise_features(sigma, 16))
    distance = jnp.linalg.norm(features[:, None] - features[None], axis=-1)
    assert float(distance[~np.eye(5, dtype=bool)].min()) > 0.5


def test_position_code_by_hand():
    code = position_code(-2, 3, 4)
    assert code.shape == (5, 4)
    np.testing.assert_allclose(code[2], [0.0, 1.0, 0.0, 1.0], atol=1e-15)  # frame 0
    rate = 1000.0 ** (-2 / 4)
    np.testing.assert_allclose(
        code[3], [np.sin(1), np.cos(1), np.sin(rate), np.cos(rate)], atol=1e-15
    )
    # History frames are the negatives of future ones: sine odd, cosine even.
    np.testing.assert_allclose(code[1], code[3] * [-1, 1, -1, 1], atol=1e-15)
    assert position_code(0, 3, 5).shape == (3, 5)


def test_section_3_3_tokens_are_history_path_and_style():
    encoder = make_encoder()
    condition = make_condition()
    context = encoder.encode(condition)
    assert context.keys.shape == context.values.shape == (2, HISTORY + WINDOW + 1, WIDTH)
    changes = {"history": slice(0, HISTORY), "path": slice(HISTORY, -1), "style": slice(-1, None)}
    for name, place in changes.items():
        other = condition._replace(**{name: getattr(condition, name) + 1.0})
        moved = jnp.abs(encoder.encode(other).keys - context.keys).max(axis=(0, 2)) > 1e-4
        expected = np.zeros(HISTORY + WINDOW + 1, bool)
        expected[place] = True
        np.testing.assert_array_equal(moved, expected)


@pytest.mark.parametrize("num_heads", [1, 2, 4])
def test_section_3_3_cross_attention_equals_a_plain_loop(num_heads):
    encoder = make_encoder(num_heads)
    condition, sigma = make_condition(), np.float32([0.5, 30.0])
    linear = lambda layer, x: x @ np.asarray(layer.kernel[...]) + np.asarray(layer.bias[...])
    expected = np.zeros((2, WINDOW, WIDTH))
    each = WIDTH // num_heads
    for b in range(2):
        tokens = np.concatenate(
            [
                linear(encoder.history, condition.history[b]) + position_code(-HISTORY, 0, WIDTH),
                linear(encoder.path, condition.path[b]) + position_code(0, WINDOW, WIDTH),
                linear(encoder.style, condition.style[b : b + 1]),
            ]
        )
        keys, values = linear(encoder.key, tokens), linear(encoder.value, tokens)
        noise = np.asarray(noise_features(jnp.asarray(sigma[b]), WIDTH))
        noise = linear(encoder.noise_second, silu(linear(encoder.noise_first, noise)))
        for t in range(WINDOW):
            asked = noise + position_code(0, WINDOW, WIDTH)[t]
            query = linear(encoder.query, asked)
            answer = np.zeros(WIDTH)
            for head in range(num_heads):
                part = slice(head * each, (head + 1) * each)
                weight = np.exp(keys[:, part] @ query[part] / np.sqrt(each))
                answer[part] = weight @ values[:, part] / weight.sum()
            expected[b, t] = asked + linear(encoder.output, answer)
    got = encoder(encoder.encode(condition), jnp.asarray(sigma))
    np.testing.assert_allclose(got, expected, atol=2e-5)


def answer_to_context(encoder, sigma=3.0):
    """The part of c that the context answers: c less the question itself."""
    first, second = (encoder(encoder.encode(make_condition(seed=s)), sigma) for s in (0, 10))
    return first - second


def test_c_varies_over_frames():
    assert float(answer_to_context(make_encoder()).std(axis=1).min()) > 1e-4


def test_without_a_position_code_c_is_the_same_in_every_frame(monkeypatch):
    monkeypatch.setattr(
        conditioning, "position_code", lambda first, last, width: np.zeros((last - first, width))
    )
    encoder = make_encoder()
    c = encoder(encoder.encode(make_condition()), 3.0)
    np.testing.assert_allclose(c, jnp.broadcast_to(c[:, :1], c.shape), atol=1e-6)


def test_c_depends_on_every_part_of_the_condition_and_on_the_noise_level():
    encoder, condition = make_encoder(), make_condition()
    c = encoder(encoder.encode(condition), 3.0)
    for name in Condition._fields:
        other = condition._replace(**{name: getattr(condition, name) + 1.0})
        assert float(jnp.abs(encoder(encoder.encode(other), 3.0) - c).max()) > 1e-4, name
    assert float(jnp.abs(encoder(encoder.encode(condition), 0.1) - c).max()) > 1e-2


def test_scalar_noise_level_equals_one_per_character():
    encoder = make_encoder()
    context = encoder.encode(make_condition(batch=3))
    np.testing.assert_allclose(encoder(context, 2.0), encoder(context, jnp.full(3, 2.0)), atol=1e-6)


def test_heads_must_divide_the_width():
    for num_heads in (0, 3):
        with pytest.raises(ValueError, match=f"divide the width {WIDTH}, got {num_heads}"):
            make_encoder(num_heads)


def film_with(gamma, beta):
    """A FiLM whose modulation is constant and whose output layer passes z_tilde on to SiLU."""
    film = FiLM(WIDTH, 5, rngs=nnx.Rngs(params=0))
    film.modulation.kernel[...] = jnp.zeros((5, 2 * WIDTH))
    film.modulation.bias[...] = jnp.concatenate(
        [jnp.full(WIDTH, float(gamma)), jnp.full(WIDTH, float(beta))]
    )
    film.output.kernel[...] = jnp.eye(WIDTH)
    film.output.bias[...] = jnp.zeros(WIDTH)
    return film


def test_eq05_to_eq07_zero_condition_weights_leave_scale_one():
    z, c = draw(2, WINDOW, WIDTH), draw(2, WINDOW, 5, seed=1)
    np.testing.assert_allclose(film_with(0.0, 0.0)(z, c), silu(z), atol=1e-6)


@pytest.mark.parametrize("gamma", [-1e4, -1.0, 0.3, 1e4])
def test_eq06_gate_stays_within_zero_and_two(gamma):
    z, c = draw(2, WINDOW, WIDTH), draw(2, WINDOW, 5, seed=1)
    gate = 1.0 + np.tanh(gamma)
    assert 0.0 <= gate <= 2.0
    np.testing.assert_allclose(film_with(gamma, 0.7)(z, c), silu(gate * z + 0.7), atol=1e-5)


def test_eq05_to_eq07_equal_plain_numpy():
    film = FiLM(WIDTH, 5, rngs=nnx.Rngs(params=0))
    film.modulation.bias[...] = jnp.asarray(draw(2 * WIDTH, seed=4))
    film.output.bias[...] = jnp.asarray(draw(WIDTH, seed=5))
    z, c = draw(2, WINDOW, WIDTH), draw(2, WINDOW, 5, seed=1)
    mixed = c @ np.asarray(film.modulation.kernel[...]) + np.asarray(film.modulation.bias[...])
    gamma, beta = mixed[..., :WIDTH], mixed[..., WIDTH:]
    z_tilde = z * (1.0 + np.tanh(gamma)) + beta
    expected = silu(
        z_tilde @ np.asarray(film.output.kernel[...]) + np.asarray(film.output.bias[...])
    )
    np.testing.assert_allclose(film(z, c), expected, atol=1e-5)


def test_eq05_modulation_is_a_frames_own():
    film, z = FiLM(WIDTH, 5, rngs=nnx.Rngs(params=0)), draw(1, WINDOW, WIDTH)
    c = draw(1, WINDOW, 5, seed=1)
    moved = film(z, jnp.asarray(c).at[0, 2].add(1.0)) - film(z, c)
    changed = np.abs(moved).max(axis=(0, 2)) > 1e-5
    np.testing.assert_array_equal(changed, np.arange(WINDOW) == 2)


def test_film_with_zero_output_starts_at_zero_but_learns():
    film = FiLM(WIDTH, 5, zero_output=True, rngs=nnx.Rngs(params=0))
    z, c = draw(2, WINDOW, WIDTH), draw(2, WINDOW, 5, seed=1)
    np.testing.assert_array_equal(film(z, c), np.zeros_like(z))
    gradient = nnx.grad(lambda m: jnp.sum(m(z, c)))(film)
    assert float(jnp.abs(gradient["output"]["kernel"][...]).max()) > 0.1


def test_cached_codes_cannot_be_spoilt_by_a_caller():
    with pytest.raises(ValueError, match="read-only"):
        position_code(0, 3, 4)[0] = 7.0


def test_encoder_runs_under_jit_like_outside():
    encoder, condition = make_encoder(2), make_condition()
    graph, state = nnx.split(encoder)

    @jax.jit
    def run(state, condition, sigma):
        module = nnx.merge(graph, state)
        return module(module.encode(condition), sigma)

    np.testing.assert_allclose(
        run(state, condition, 2.0), encoder(encoder.encode(condition), 2.0), atol=1e-5
    )
