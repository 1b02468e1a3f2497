"""Encoder of images and text of Florence-2 (Xiao et al. 2024), with the user's weights, as FLOWER takes it.

The package transformers has the network. Its decoder and the head that predicts words are left out: images go through
the vision encoder (DaViT) and its projection, and their tokens together with those of the text through the encoder of
the language model. Images are prepared here as Florence-2's processor does: ImageNet's mean and deviation.
"""

from __future__ import annotations

import json
import math
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import torch
from torch import nn

from concent_warp.documents import read_json
from concent_warp.errors import TrainError

MEAN, STD = (0.485, 0.456, 0.406), (0.229, 0.224, 0.225)
"""Mean and standard deviation of colours that the network was trained with [-]."""
EXPECTED = "Florence-2 in the format of transformers: config.json, model.safetensors and tokenizer.json"
SOURCE = "such as a copy of florence-community/Florence-2-large (MIT)"
KIND = "florence2"
EXTRA = "pip install 'concent-warp[florence2]'"


class FlorenceBackbone(nn.Module):
    """Tokens of images and text by Florence-2."""

    mean: torch.Tensor
    std: torch.Tensor

    def __init__(self, settings: Mapping[str, Any], tokenizer: str, cameras: int, edge: int) -> None:
        """Make the network with random weights.

        Args:
            settings: Florence-2's configuration.
            tokenizer: Content of its `tokenizer.json`.
            cameras: Number of cameras.
            edge: Height and width of the images [px].

        Raises:
            TrainError: The package transformers is missing, configuration or tokenizer are not right, or the images
                have more tokens than the network has positions.
        """
        super().__init__()
        self.settings, self.tokenizer = dict(settings), tokenizer
        with _reading("the description of Florence-2"):
            from tokenizers import Tokenizer  # pyright: ignore
            from transformers import Florence2Config, Florence2Model  # pyright: ignore

            config: Any = Florence2Config.from_dict(dict(settings))
            model: Any = Florence2Model(config)
            self._tokenizer = Tokenizer.from_str(tokenizer)
            self._tokenizer.no_padding()
            self._tokenizer.no_truncation()
        self.vision, self.projection = model.vision_tower, model.multi_modal_projector
        self.embedding, self.encoder = model.language_model.shared, model.language_model.encoder
        self.encoder.embed_tokens = nn.Identity()  # embeddings of text and images are given
        self.width = int(config.text_config.d_model)
        cells = edge // math.prod(config.vision_config.patch_stride)
        positions = int(config.text_config.max_position_embeddings)
        self._longest = positions - cameras * (cells * cells + 1)
        if self._longest < 1 or cells > config.vision_config.max_position_embeddings:
            fix = "make the images smaller, or choose fewer cameras"
            found = f"{cameras} images of {edge} px"
            raise TrainError("the images have more tokens than Florence-2 has positions", found=found, fix=fix)
        self._padding = int(config.text_config.pad_token_id or 0)
        for name, values in (("mean", MEAN), ("std", STD)):
            self.register_buffer(name, torch.tensor(values).reshape(1, 3, 1, 1), persistent=False)

    @staticmethod
    def load(folder: Path, cameras: int, edge: int) -> FlorenceBackbone:
        """Return the network of a folder with its weights; see the constructor for the rest.

        Raises:
            TrainError: The package or the weights are missing, or they are of another network.
        """
        settings, tokenizer = _described(folder)
        backbone = FlorenceBackbone(settings, tokenizer, cameras, edge)
        with _reading("the weights", folder), _quiet():
            from transformers import Florence2ForConditionalGeneration  # pyright: ignore

            options: dict[str, Any] = {"local_files_only": True, "use_safetensors": True, "output_loading_info": True}
            found: Any = Florence2ForConditionalGeneration.from_pretrained(folder, dtype=torch.float32, **options)
            whole, loaded = found
        if missing := sorted(loaded["missing_keys"]):
            more = f" and {len(missing) - 3} more" if len(missing) > 3 else ""
            raise TrainError(
                "weights are missing", where=folder, expected=EXPECTED, found=f"no {', '.join(missing[:3])}{more}"
            )
        model = whole.model
        backbone.vision.load_state_dict(model.vision_tower.state_dict())
        backbone.projection.load_state_dict(model.multi_modal_projector.state_dict())
        backbone.embedding.load_state_dict(model.language_model.shared.state_dict())
        kept = {
            n: v for n, v in model.language_model.encoder.state_dict().items() if n in backbone.encoder.state_dict()
        }
        backbone.encoder.load_state_dict(kept)
        return backbone

    def tokens_of(self, texts: Sequence[str]) -> tuple[torch.Tensor, torch.Tensor]:
        """Return the tokens of texts, shape (N, L) int64, and which of them there are, shape (N, L) bool.

        Raises:
            TrainError: A text is too long.
        """
        encoded = [self._tokenizer.encode(text).ids or [self._padding] for text in texts]
        length = max(map(len, encoded), default=0)
        if length > self._longest:
            raise TrainError("an instruction is too long", expected=f"at most {self._longest} tokens", found=length)
        ids = torch.tensor([row + [self._padding] * (length - len(row)) for row in encoded])
        mask = torch.tensor([[k < len(row) for k in range(length)] for row in encoded])
        return ids, mask

    def forward(self, images: torch.Tensor, ids: torch.Tensor, mask: torch.Tensor) -> tuple[torch.Tensor, torch.Tensor]:
        """Return tokens (N, L', W), and which of them there are, shape (N, L') bool.

        Args:
            images: Images of K cameras in 0..1, shape (N, K, 3, S, S).
            ids: Tokens of the text, shape (N, L) int64.
            mask: Which of these there are, shape (N, L) bool.
        """
        count, cameras = images.shape[:2]
        pixels = (images.flatten(0, 1) - self.mean) / self.std
        seen = self.projection(self.vision(pixels).last_hidden_state)
        seen = seen.unflatten(0, (count, cameras)).flatten(1, 2)
        x = torch.cat([seen, self.embedding(ids).to(seen.dtype)], dim=1)
        there = torch.ones(seen.shape[:2], dtype=torch.bool, device=x.device)
        mask = torch.cat([there, mask], dim=1)
        found = self.encoder(inputs_embeds=x, attention_mask=mask.to(torch.int64))
        return found.last_hidden_state, mask


def _described(folder: Path) -> tuple[dict[str, Any], str]:
    """Return configuration and tokenizer of Florence-2 in a folder.

    Raises:
        TrainError: They are missing, or the folder has another network.
    """
    for name in ("config.json", "tokenizer.json"):
        if not (folder / name).is_file():
            found = "no such folder" if not folder.is_dir() else f"no {name}"
            raise TrainError("no weights of Florence-2", where=folder, expected=f"{EXPECTED}, {SOURCE}", found=found)
    settings = read_json(folder / "config.json", TrainError)
    kind = settings.get("model_type") if isinstance(settings, dict) else type(settings).__name__
    if kind != KIND:
        fix = (
            "microsoft's own files are of another format: take florence-community's" if kind == "florence2_vl" else None
        )
        raise TrainError("the weights are of another model", where=folder, expected=KIND, found=kind, fix=fix)
    return json.loads(json.dumps(settings)), (folder / "tokenizer.json").read_text()


@contextmanager
def _reading(what: str, where: Path | None = None) -> Iterator[None]:
    """Turn what transformers raises within the context into one sentence.

    Raises:
        TrainError: The package is missing, or it cannot read what it is given.
    """
    try:
        yield
    except ImportError as error:
        raise TrainError("Florence-2 needs the package transformers", found=error, fix=EXTRA) from None
    except TrainError:
        raise
    except Exception as error:  # tokenizers raises Exception itself, transformers whatever its parts do
        found = next(iter(str(error).splitlines()), type(error).__name__)
        raise TrainError(f"{what} cannot be read", where=where, expected=EXPECTED, found=found) from None


@contextmanager
def _quiet() -> Iterator[None]:
    """Keep transformers from showing bars and reports while it loads weights."""
    from transformers.utils import logging  # pyright: ignore

    shown, level = logging.is_progress_bar_enabled(), logging.get_verbosity()
    logging.disable_progress_bar()
    logging.set_verbosity_error()
    try:
        yield
    finally:
        logging.set_verbosity(level)
        if shown:
            logging.enable_progress_bar()
