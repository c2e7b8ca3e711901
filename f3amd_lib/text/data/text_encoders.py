"""Captions as vectors: one interface for text encoders, and a cache so that no training runs one.

| name | what | tokens, width | where its weights are |
|---|---|---|---|
| `wordllama` | a vector a word piece, pooled by their mean | 256 | in its package: works offline |
| `clip` | CLIP ViT-B/32, the choice of ACMDM | 512 | a folder of yours |
| `t5` | Sentence-T5 (large), the choice of MotionPCM | 1024, pooled 768 | a folder of yours |
| `load_glove` | of the published evaluators: a vector a word, and its part of speech | 315 | a folder of yours |
| `load_clip_pieces` | of the evaluator of ACMDM's CLIP-score: numbers of word pieces | 1 | a folder of yours |

CLIP and T5 run in PyTorch by way of `transformers`; a folder is that of the published model, with weights
as safetensors.
`wordllama` is a mean of word vectors, so that "left hand up, right hand down" and the other way
round are one to its pooled vector; the token vectors keep their order.
"""

import hashlib
import importlib.util
import pickletools
import re
import warnings
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import NamedTuple

import numpy as np

from f3amd_lib.data.packed import cache_folder
from f3amd_lib.ground.files import read_toml, whole_file
from f3amd_lib.ground.names import check_known, nearest_hint

MOST_TOKENS = 77
"""Word pieces of a caption that an encoder reads, those of CLIP; longer ones are cut there."""


_PLAIN = dict.fromkeys("‘’‚‛′´`", "'") | dict.fromkeys("“”„‟″«»", '"') | dict.fromkeys("‐‑‒−", "-")
_PLAIN |= dict.fromkeys("–—―", " - ") | dict.fromkeys("\u00a0\u202f\u2009", " ") | {"…": "..."}


class TextEmbeddings(NamedTuple):
    """Captions as vectors.

    Attributes:
      tokens: [captions, tokens, width], float32; 0 beyond a caption's end.
      mask: true for tokens, [captions, tokens].
      pooled: one vector a caption, [captions, pooled width], float32.
    """

    tokens: np.ndarray
    mask: np.ndarray
    pooled: np.ndarray


@dataclass(frozen=True, eq=False)
class TextEncoder:
    """What turns captions into vectors.

    Attributes:
      identity: name and state of the weights: embeddings of two identities do not mix.
      width: of token vectors.
      embed: function from captions to their token vectors, [tokens, width] each, and their pooled vectors; the empty
        caption has some, too, with which MotionPCM says nothing.
    """

    identity: str
    width: int
    embed: Callable[[Sequence[str]], tuple[Sequence[np.ndarray], Sequence[np.ndarray]]]

    def __call__(self, captions: Sequence[str]) -> TextEmbeddings:
        """Embed captions that `check_captions` has passed; a warning, once, where one is too long to be read whole."""
        pieces, pooled = self.embed(captions)
        if max(map(len, pieces)) >= MOST_TOKENS:
            warnings.warn(f"captions of more than {MOST_TOKENS} word pieces are cut there", stacklevel=2)
        return _padded(pieces, pooled)


def plain_caption(caption: str) -> str:
    """Return a caption with typewriter's quotes, dashes and blanks instead of a printer's."""
    return caption.translate(str.maketrans(_PLAIN))


def check_captions(captions: Sequence[str]) -> None:
    """Refuse what no motion could follow.

    Raises:
      ValueError: for a caption that is empty, or has no letters, saying which.
    """
    if isinstance(captions, str):
        raise ValueError(f"captions must be a list of texts, got the one text {captions!r}; put it into a list")
    for number, caption in enumerate(captions, 1):
        if not re.search(r"[^\W\d_]", caption):
            raise ValueError(f"caption {number} of {len(captions)}, {caption!r}, has no word; say what the person does")


def check_words(caption: str, known: Sequence[str]) -> None:
    """Refuse words that a model has never seen in its captions.

    Args:
      caption: to check.
      known: captions that the model was trained with.

    Raises:
      ValueError: naming the words, and the nearest known one of the first.
    """
    vocabulary = words_of(known)
    if unknown := [word for word in _words(caption) if word not in vocabulary]:
        hint = nearest_hint(unknown[0], vocabulary)
        never = f"the model never saw {', '.join(map(repr, unknown))}{hint}"
        raise ValueError(f"caption {caption!r}: {never}; --any-words (any_words=True) allows them")


def words_of(captions: Sequence[str]) -> tuple[str, ...]:
    """Return the words of captions, in small letters, each once, sorted."""
    return tuple(sorted(set(_words(" ".join(captions)))))


def _words(text: str) -> list[str]:
    return re.findall(r"[^\W\d_]+(?:['-][^\W\d_]+)*", plain_caption(text).lower())


def _padded(pieces: Sequence[np.ndarray], pooled) -> TextEmbeddings:
    """Put token vectors of unlike numbers side by side."""
    lengths = np.array([len(piece) for piece in pieces])
    tokens = [np.pad(piece, ((0, lengths.max() - len(piece)), (0, 0))) for piece in pieces]
    mask = np.arange(lengths.max()) < lengths[:, None]
    return TextEmbeddings(np.array(tokens, np.float32), mask, np.asarray(pooled, np.float32))


def load_wordllama() -> TextEncoder:
    """Read wordllama's 32,000 vectors of 256 numbers (16 MB) from the installed package, offline.

    Vectors have a mean length of 1.

    Raises:
      ImportError: if the package is not installed.
      ValueError: if its files are not those expected.
    """
    found = importlib.util.find_spec("wordllama")
    if found is None:
        raise ImportError('the text encoder wordllama is not installed: pip install "wordllama>=0.2.2,<0.2.3"')
    from safetensors.numpy import load_file
    from tokenizers import Tokenizer

    folder = Path(found.origin).parent
    try:
        vectors = load_file(folder / "weights" / "l2_supercat_256.safetensors")["embedding.weight"].astype(np.float32)
        tokenizer = Tokenizer.from_file(str(folder / "tokenizers" / "l2_supercat_tokenizer_config.json"))
    except Exception as error:  # tokenizers raises Exception itself
        raise ValueError(f"{folder}: not the files of wordllama 0.2 ({error}); install it again") from error
    vectors = vectors / np.linalg.norm(vectors, axis=-1).mean()

    def embed(captions):
        encoded = [tokenizer.encode(caption, add_special_tokens=False) for caption in captions]
        for caption, pieces in zip(captions, encoded, strict=True):
            # What the vocabulary does not know is spelled out in bytes.
            if any(re.fullmatch("<0x[0-9A-F]{2}>|<unk>", piece) for piece in pieces.tokens):
                raise ValueError(f"caption {caption!r} holds characters unknown to wordllama; use English")
        pieces = [vectors[pieces.ids[:MOST_TOKENS]] for pieces in encoded]
        return pieces, [piece.mean(axis=0) if len(piece) else np.zeros(piece.shape[1:]) for piece in pieces]

    return TextEncoder("wordllama-l2-supercat-256", vectors.shape[1], embed)


def _load_transformers(kind: str, folder) -> TextEncoder:
    """Read CLIP's or Sentence-T5's text side from a folder of the user; ValueError names what is missing."""
    folder = Path(folder or "").expanduser()
    needed = [folder / "config.json", *([folder / "2_Dense" / "model.safetensors"] if kind == "t5" else [])]
    if missing := [path for path in needed if not path.is_file()]:
        raise ValueError(f"{kind}: {missing[0]} is missing; give the folder of its weights (--text-weights)")
    if importlib.util.find_spec("transformers") is None or importlib.util.find_spec("torch") is None:
        raise ImportError(f"the text encoder {kind} needs transformers and torch: make bench-tools")
    import torch
    import transformers
    from safetensors.torch import load_file

    offline = {"local_files_only": True, "use_safetensors": True}  # never a pickle
    tokenizer = transformers.AutoTokenizer.from_pretrained(folder, local_files_only=True)
    network = transformers.CLIPTextModelWithProjection if kind == "clip" else transformers.T5EncoderModel
    model = network.from_pretrained(folder, **offline).eval()
    dense = None if kind == "clip" else load_file(needed[1])["linear.weight"].float()

    def embed(captions):
        how = {"padding": True, "truncation": True, "max_length": MOST_TOKENS, "return_tensors": "pt"}
        given = tokenizer(list(captions), **how)
        with torch.no_grad():
            output = model(**given)
        mask, tokens = given["attention_mask"].bool(), output.last_hidden_state
        if dense is None:
            pooled = output.text_embeds
        else:  # Sentence-T5: the mean of the tokens through one linear layer, of length 1
            weights = mask[..., None].to(tokens.dtype)
            pooled = torch.nn.functional.normalize((tokens * weights).sum(1) / weights.sum(1) @ dense.T, dim=-1)
        pieces = [row[kept] for row, kept in zip(tokens.float().numpy(), mask.numpy(), strict=True)]
        return pieces, pooled.float().numpy()

    digest = hashlib.sha256(b"".join(file.read_bytes() for file in sorted(folder.glob("*.safetensors"))))
    return TextEncoder(f"{kind}-{digest.hexdigest()[:12]}", model.config.hidden_size, embed)


def load_text_encoder(name: str = "wordllama", folder=None) -> TextEncoder:
    """Return a text encoder by name.

    Args:
      name: "wordllama", "clip" or "t5".
      folder: of the weights, for the last two.

    Raises:
      ValueError: for an unknown name, or weights that are not there.
      ImportError: naming the package that is missing.
    """
    check_known(name, ("wordllama", "clip", "t5"), "text encoder")
    return load_wordllama() if name == "wordllama" else _load_transformers(name, folder)


def load_glove(folder, tagged: Mapping[str, str]) -> TextEncoder:
    """Read the GloVe vectors of the published evaluators: 300 numbers a word, then 15 for its part of speech.

    Args:
      folder: with `our_vab_data.npy` and `our_vab_idx.pkl`; of the latter, a pickle, the operations are listed and
        none is run.
      tagged: words with tags, "a/DET person/NOUN walk/VERB", of each caption (`humanml3d.tagged_captions`).

    Raises:
      ValueError: naming the file that is missing or another one; and, when embedding, a caption without tags.
    """
    about, folder = read_toml(Path(__file__).with_name("tags.toml")), Path(folder)
    try:
        vectors = np.load(folder / "our_vab_data.npy", allow_pickle=False)
        operations = list(pickletools.genops((folder / "our_vab_idx.pkl").read_bytes()))
        said = [what for how, what, _ in operations if "UNICODE" in how.name or how.name.startswith("BININT")]
        place = dict(zip(said[::2], said[1::2], strict=True))
        unknown = vectors[place["unk"]]
    except (OSError, ValueError, LookupError) as error:
        raise ValueError(f"{folder}: not the GloVe files of the evaluators ({error}); fetch them again") from error
    special = {word: kind for kind, words in about["words"].items() for word in words.split()}
    tags = {tag: row for tag, row in zip(about["tags"], np.eye(len(about["tags"])), strict=True)}

    def vector(token):
        word, _, tag = token.rpartition("/")
        if word not in place:
            return np.concatenate([unknown, tags["OTHER"]])
        return np.concatenate([vectors[place[word]], tags.get(special.get(word, tag), tags["OTHER"])])

    def embed(captions):
        if missing := [caption for caption in captions if caption not in tagged]:
            raise ValueError(f"caption {missing[0]!r} has no tags; judge captions of the data set's texts alone")
        cut = [["sos/OTHER", *tagged[caption].split()[:20], "eos/OTHER"] for caption in captions]
        pieces = [np.array([vector(token) for token in tokens]) for tokens in cut]
        return pieces, [piece.mean(axis=0) for piece in pieces]

    digest = hashlib.sha256(vectors.tobytes() + repr(sorted(tagged.items())).encode())
    return TextEncoder(f"glove-{digest.hexdigest()[:12]}", vectors.shape[1] + len(tags), embed)


def load_clip_pieces(folder) -> TextEncoder:
    """Return captions as numbers of CLIP's word pieces, for the evaluator of ACMDM's CLIP-score.

    Args:
      folder: with `tokenizer.json` of CLIP ViT-B/16, as `transformers` keeps it.

    Raises:
      ValueError: naming a file that is missing or of another kind.
    """
    from tokenizers import Tokenizer

    path = Path(folder) / "tokenizer.json"
    try:
        tokenizer, content = Tokenizer.from_file(str(path)), path.read_bytes()
    except Exception as error:  # tokenizers raises Exception itself
        raise ValueError(f"{path}: no tokeniser ({error}); fetch CLIP's folder again") from error
    tokenizer.enable_truncation(MOST_TOKENS)

    def embed(captions):
        pieces = [np.array(encoded.ids, np.float32)[:, None] for encoded in tokenizer.encode_batch(list(captions))]
        return pieces, [piece.mean(axis=0) for piece in pieces]

    return TextEncoder(f"pieces-{hashlib.sha256(content).hexdigest()[:12]}", 1, embed)


def embed_captions(captions: Sequence[str], encoder: TextEncoder) -> TextEmbeddings:
    """Return captions as vectors, from the cache if they were embedded before.

    The cache (F3AMD_CACHE_DIR overrides its place) has one file for each encoder and list of captions.

    Raises:
      ValueError: for a caption that is empty, or that the encoder cannot read.
    """
    check_captions(captions)
    captions = [plain_caption(caption) for caption in captions]
    key = hashlib.sha256("\n".join([encoder.identity, *captions]).encode()).hexdigest()[:16]
    path = cache_folder() / f"captions-{encoder.identity}-{key}.npz"
    if path.exists():
        try:
            with np.load(path, allow_pickle=False) as file:
                kept = TextEmbeddings(*(file[name] for name in TextEmbeddings._fields))
            if len(kept.tokens) == len(captions) and np.isfinite(kept.tokens).all():
                return kept
        except (OSError, ValueError, KeyError, EOFError, zipfile.BadZipFile):
            pass  # a damaged cache file is written anew
    parts = [encoder(captions[first : first + 256]) for first in range(0, len(captions), 256)]
    pieces = [row[kept] for part in parts for row, kept in zip(part.tokens, part.mask, strict=True)]
    embedded = _padded(pieces, np.concatenate([part.pooled for part in parts]))
    with whole_file(path, overwrite=True) as temporary, temporary.open("wb") as file:
        np.savez(file, **embedded._asdict())
    return embedded
