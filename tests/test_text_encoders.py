"""Text encoders: the offline one as installed, the interface and its cache with one of the test's own."""

import json
import socket
import warnings

import numpy as np
import pytest
from builders import refused

from f3amd_companion.__main__ import main
from f3amd_lib.text.data import text_encoders


class Letters:
    """Every letter is a token: its place in the alphabet, twice."""

    identity, width = "letters", 2

    def __init__(self):
        self.calls = 0

    def __call__(self, captions) -> text_encoders.TextEmbeddings:
        self.calls += 1
        pieces = [np.array([[ord(c), ord(c)] for c in caption], np.float32) for caption in captions]
        return text_encoders._padded(pieces, [piece.mean(axis=0) for piece in pieces])


def test_captions_of_unlike_lengths_are_padded_and_masked(cache_dir):
    embedded = text_encoders.embed_captions(["ab", "abcd"], Letters())
    assert embedded.tokens.shape == (2, 4, 2) and embedded.mask.tolist() == [[True, True, False, False], [True] * 4]
    assert np.all(embedded.tokens[0, 2:] == 0) and embedded.tokens[1, 3, 0] == ord("d")
    assert embedded.pooled[0, 0] == pytest.approx(ord("a") + 0.5)


def test_what_was_embedded_is_not_embedded_again(cache_dir):
    encoder, captions = Letters(), ["ab", "abcd"]
    first = text_encoders.embed_captions(captions, encoder)
    again = text_encoders.embed_captions(captions, encoder)
    assert encoder.calls == 1
    assert all(np.array_equal(mine, theirs) for mine, theirs in zip(first, again, strict=True))
    text_encoders.embed_captions(captions[::-1], encoder)
    assert encoder.calls == 2
    for file in cache_dir.iterdir():
        file.write_bytes(file.read_bytes()[:50])
    assert np.array_equal(text_encoders.embed_captions(captions, encoder).tokens, first.tokens) and encoder.calls == 3


def test_encoders_of_unlike_weights_do_not_share_what_they_embedded(cache_dir):
    other = Letters()
    other.identity = "letters-of-another-folder"
    for encoder in (Letters(), other):
        text_encoders.embed_captions(["ab", "abcd"], encoder)
        assert encoder.calls == 1


def test_training_and_measuring_take_an_encoder_by_name(tmp_path, capsys, monkeypatch):
    monkeypatch.setattr("f3amd_lib.text.stages.text_models.open_text_motions", lambda *_: None)
    for words in (["train", "--preset", "judge"], ["measure", "text_judge"]):
        assert main([*words, "--data", "bandai", "--text-encoder", "t5", "--text-weights", str(tmp_path)]) == 2
        assert f"t5: {tmp_path / 'config.json'} is missing" in capsys.readouterr().err


@pytest.mark.parametrize(
    "printed, typed", [("“A person’s”", '"A person\'s"'), ("well‑known … – so", "well-known ...  -  so")]
)
def test_printers_quotes_and_dashes_are_embedded_as_those_of_a_keyboard(cache_dir, printed, typed):
    ours, theirs = (text_encoders.embed_captions([caption], Letters()).tokens for caption in (printed, typed))
    assert np.array_equal(ours, theirs)


def test_an_empty_caption_is_refused(cache_dir):
    refused("caption 2 of 2, .* has no word", text_encoders.embed_captions, ["a walk", "  "], Letters())
    refused("has no word", text_encoders.embed_captions, ["12 34 ..."], Letters())
    refused("put it into a list", text_encoders.embed_captions, "a walk", Letters())


def test_words_that_a_model_never_saw_are_named():
    known = ["a person raises the left hand", "an elderly person walks"]
    text_encoders.check_words("An elderly person raises the hand.", known)
    text_encoders.check_words("A person’s hand", ["a person's hand"])
    told = "never saw 'walsk', 'happily'; did you mean 'walks'.*--any-words"
    refused(told, text_encoders.check_words, "a person walsk happily", known)


def test_unknown_encoders_and_missing_weights_are_named(tmp_path):
    refused("unknown text encoder 'wordlama'; did you mean 'wordllama'", text_encoders.load_text_encoder, "wordlama")
    for name in ("clip", "t5"):
        refused(rf"{name}: .*config.json is missing; give the folder", text_encoders.load_text_encoder, name, tmp_path)


# ----------------------------------------------------------------------------------- the real ones


@pytest.fixture(scope="module")
def wordllama():
    return text_encoders.load_text_encoder("wordllama")


@pytest.mark.wants("wordllama", "tokenizers")
def test_wordllama_works_without_a_network(monkeypatch, cache_dir):
    def refuse(*args, **kwargs):
        pytest.fail("the network was touched")

    monkeypatch.setattr(socket, "socket", refuse)
    embedded = text_encoders.embed_captions(["a person raises the left hand"], text_encoders.load_text_encoder())
    assert embedded.tokens.shape == (1, 7, 256) and embedded.tokens.dtype == np.float32
    assert np.allclose(embedded.pooled, embedded.tokens.mean(axis=1), atol=1e-6)


@pytest.mark.wants("wordllama", "tokenizers")
def test_wordllama_tells_actions_apart(wordllama):
    def cosine(first, second):
        a, b = wordllama([first, second]).pooled
        return float(a @ b / np.linalg.norm(a) / np.linalg.norm(b))

    wave = "a person waves goodbye"
    assert cosine(wave, "a person says goodbye by waving the right hand") > 0.6
    assert cosine(wave, "someone kicks a ball") < 0.4
    # A mean of words knows no order: what its page says, and why token vectors go with it.
    swapped = "left hand up and right hand down", "right hand up and left hand down"
    assert cosine(*swapped) > 0.999
    tokens = wordllama(swapped).tokens
    assert np.abs(tokens[0] - tokens[1]).max() > 0.1


@pytest.mark.wants("wordllama", "tokenizers")
def test_wordllama_refuses_what_it_cannot_read(wordllama):
    refused("characters unknown to wordllama", wordllama, ["a person \U0001f6b6 walks"])


@pytest.mark.wants("wordllama", "tokenizers")
def test_no_words_are_the_zero_vector_to_a_mean_of_words(wordllama):
    assert wordllama.embed([""])[1][0].tolist() == [0.0] * 256 and not wordllama([""]).pooled.any()


@pytest.mark.wants("wordllama", "tokenizers")
def test_a_long_caption_is_cut_and_that_is_said_once(wordllama):
    said = "a person walks " * 10
    with warnings.catch_warnings():
        warnings.simplefilter("error")
        whole = wordllama([said])
    with warnings.catch_warnings(record=True) as told:
        warnings.simplefilter("default")
        for tail in ("and sits down", "and jumps"):
            cut = wordllama([3 * said + tail, said])
            assert cut.mask.sum(axis=1).tolist() == [77, 41]
            assert np.array_equal(cut.tokens[0, :40], whole.tokens[0, :40])
    assert [str(one.message) for one in told] == ["captions of more than 77 word pieces are cut there"]


@pytest.mark.wants("tokenizers")
def test_word_pieces_are_told_by_their_numbers(tmp_path):
    import tokenizers

    words = {word: number for number, word in enumerate(["<pad>", "<start>", "<end>", "a", "walk"])}
    tokenizer = tokenizers.Tokenizer(tokenizers.models.WordLevel(words, unk_token="<pad>"))
    tokenizer.pre_tokenizer = tokenizers.pre_tokenizers.Whitespace()
    ends = [("<start>", 1), ("<end>", 2)]
    tokenizer.post_processor = tokenizers.processors.TemplateProcessing(single="<start> $A <end>", special_tokens=ends)
    tokenizer.save(str(tmp_path / "tokenizer.json"))
    encoder = text_encoders.load_clip_pieces(tmp_path)
    embedded = encoder(["a walk", "walk"])
    assert embedded.tokens[..., 0].tolist() == [[1, 3, 4, 2], [1, 4, 2, 0]] and embedded.mask.sum() == 7
    with pytest.warns(UserWarning, match="cut there"):
        cut = encoder(["walk " * 100])
    assert cut.tokens[0, [0, -1], 0].tolist() == [1, 2] and cut.mask.sum() == 77
    refused("tokenizer.json: no tokeniser", text_encoders.load_clip_pieces, tmp_path / "elsewhere")


@pytest.mark.needs("transformers", "torch")
def test_clip_by_way_of_transformers(tmp_path, cache_dir):
    """A CLIP of random weights with a vocabulary of letters: the road, not the quality."""
    import torch
    import transformers

    letters = [chr(code) for code in range(ord("a"), ord("z") + 1)]
    pieces = ["<|startoftext|>", "<|endoftext|>", *letters, *(f"{letter}</w>" for letter in letters)]
    (tmp_path / "vocab.json").write_text(json.dumps({piece: k for k, piece in enumerate(pieces)}))
    (tmp_path / "merges.txt").write_text("#version: 0.2\n")
    tokenizer = transformers.CLIPTokenizer(str(tmp_path / "vocab.json"), str(tmp_path / "merges.txt"))
    tokenizer.save_pretrained(tmp_path)
    torch.manual_seed(0)
    sizes = {"hidden_size": 16, "intermediate_size": 32, "num_hidden_layers": 1, "num_attention_heads": 2}
    ends = {"bos_token_id": 0, "eos_token_id": 1, "pad_token_id": 1}
    config = transformers.CLIPTextConfig(vocab_size=len(pieces), projection_dim=12, **sizes, **ends)
    transformers.CLIPTextModelWithProjection(config).save_pretrained(tmp_path)
    encoder = text_encoders.load_text_encoder("clip", tmp_path)
    embedded = text_encoders.embed_captions(["walk", "he runs"], encoder)
    assert encoder.width == 16 and embedded.tokens.shape[::2] == (2, 16) and embedded.pooled.shape == (2, 12)
    assert embedded.mask.sum(axis=1).tolist() == [6, 8]
    with pytest.warns(UserWarning, match="cut there"):
        assert encoder(["walk " * 40]).mask.sum() == 77
    alone = encoder(["walk"])
    assert np.allclose(alone.pooled, embedded.pooled[:1], atol=1e-5)  # padding changes nothing
