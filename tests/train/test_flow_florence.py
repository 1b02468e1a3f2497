"""Florence-2 as the encoder of a flow policy, in a tiny random configuration."""

from __future__ import annotations

import json
import sys
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

import concent_warp as cw
from concent_warp.cli.entry import main
from concent_warp.train.flow.florence_backbone import FlorenceBackbone
from tests.train.flow_dataset import DOWN, SIZES, TINY, UP, image, write_dataset

EDGE = 32


@pytest.fixture(scope="module")
def weights(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Return a folder with a tiny Florence-2 of random weights and its tokenizer."""
    from tokenizers import Tokenizer, models, pre_tokenizers  # pyright: ignore
    from transformers import BartConfig, Florence2Config, Florence2ForConditionalGeneration  # pyright: ignore

    folder = tmp_path_factory.mktemp("florence")
    torch.manual_seed(0)
    words = {word: k for k, word in enumerate(["<s>", "<pad>", "</s>", "<unk>", "push", "it", "up", "down"])}
    text = BartConfig(
        vocab_size=16, d_model=16, encoder_layers=1, decoder_layers=1, encoder_attention_heads=2,
        decoder_attention_heads=2, encoder_ffn_dim=32, decoder_ffn_dim=32, max_position_embeddings=64,
    )  # fmt: skip
    vision = {
        "depths": (1, 1, 1, 1), "embed_dim": (8, 8, 16, 16), "num_heads": (1, 1, 2, 2), "num_groups": (1, 1, 2, 2),
        "window_size": 4, "projection_dim": 16, "max_position_embeddings": 10, "max_temporal_embeddings": 4,
    }  # fmt: skip
    config = Florence2Config(text_config=text.to_dict(), vision_config=vision, image_token_id=15)
    Florence2ForConditionalGeneration(config).save_pretrained(folder)
    tokenizer = Tokenizer(models.WordLevel(words, unk_token="<unk>"))
    tokenizer.pre_tokenizer = pre_tokenizers.Whitespace()
    tokenizer.save(str(folder / "tokenizer.json"))
    return folder


@pytest.fixture(scope="module")
def data(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return write_dataset(tmp_path_factory.mktemp("flow") / "data", episodes=4, cameras=("front", "side"))


def settings(weights: Path, steps: int = 4) -> cw.TrainFlowCfg:
    sizes = replace(SIZES, backbone="florence2", weights=weights, size=EDGE)
    return replace(TINY, steps=steps, batch=4, validate=2, learning_rate=None, policy=sizes)


def test_tokens_are_those_of_the_whole_network(weights):
    from transformers import Florence2ForConditionalGeneration  # pyright: ignore

    whole: Any = Florence2ForConditionalGeneration.from_pretrained(weights).eval()
    backbone = FlorenceBackbone.load(weights, 1, EDGE).eval()
    images = torch.rand(2, 1, 3, EDGE, EDGE)
    ids, mask = backbone.tokens_of([UP, "push"])
    assert mask.tolist() == [[True] * 3, [True, False, False]]
    with torch.no_grad():
        found, there = backbone(images, ids, mask)
        pixels = (images[:, 0] - backbone.mean) / backbone.std
        seen = whole.model.get_image_features(pixels).pooler_output
        inputs = torch.cat([seen, whole.get_input_embeddings()(ids)], dim=1)
        expected = whole.model.language_model.encoder(
            inputs_embeds=inputs, attention_mask=there.long()
        ).last_hidden_state
    assert found.shape == (2, 2 + 3, 16)  # one cell of the image, their mean, and the text
    torch.testing.assert_close(found, expected)
    assert not any("decoder" in name or "lm_head" in name for name in backbone.state_dict())


def test_policy_on_florence_is_trained_and_read_without_its_folder(weights, data, tmp_path):
    assert settings(weights).peak == 2e-5  # FLOWER's
    trained = cw.train_flow(data, settings(weights), device="cpu", out=tmp_path / "run")
    policy = cw.load_flow_policy(tmp_path / "run")
    assert policy.cfg.weights is None
    seen = {name: np.stack([image(0.3)] * 2) for name in ("front", "side")}
    noise = torch.randn(2, 4, 3)
    found = policy.act(seen, np.zeros((2, 1)), [UP, DOWN], noise=noise)
    np.testing.assert_array_equal(found, trained.act(seen, np.zeros((2, 1)), [UP, DOWN], noise=noise))
    assert np.isfinite(found).all()
    before, after = FlorenceBackbone.load(weights, 2, EDGE), policy.network.backbone
    moved = [not torch.equal(v, after.state_dict()[n]) for n, v in before.state_dict().items() if v.is_floating_point()]
    assert np.mean(moved) > 0.8  # it is trained, too


def test_continued_training_is_the_one_without_interruption(weights, data, tmp_path):
    whole = cw.train_flow(data, settings(weights), device="cpu")

    def stop(said):
        if said.step is not None and said.step.done == 2:
            raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        cw.train_flow(data, settings(weights), device="cpu", out=tmp_path / "run", progress=stop)
    resumed = cw.train_flow(data, settings(weights), device="cpu", out=tmp_path / "run", resume=True)
    for name, value in whole.network.state_dict().items():
        assert torch.equal(value, resumed.network.state_dict()[name]), name


def test_missing_or_other_weights_are_said_in_one_sentence(weights, data, tmp_path, capsys, monkeypatch):
    def said(*options: str) -> str:
        assert main(["train-flow", str(data), "-o", str(tmp_path / "run"), "--device", "cpu", *options]) == 2
        assert not (tmp_path / "run").exists()
        return capsys.readouterr().err.strip().splitlines()[-1]

    assert "Florence-2 needs weights" in said("--backbone", "florence2")
    given = ["--backbone", "florence2", "--policy.size", str(EDGE), "--weights"]
    assert "no such folder" in said(*given, str(tmp_path / "nowhere"))
    assert "takes no weights" in said("--weights", str(weights))
    assert "multiple of 32" in said(*given, str(weights), "--policy.size", "40")
    other = tmp_path / "other"
    other.mkdir()
    (other / "tokenizer.json").write_text((weights / "tokenizer.json").read_text())
    (other / "config.json").write_text(json.dumps({"model_type": "sam2_video"}))
    assert "another model; expected florence2, found sam2_video" in said(*given, str(other))
    config = json.loads((weights / "config.json").read_text())
    (other / "config.json").write_text(json.dumps(config))
    assert "weights cannot be read" in said(*given, str(other))
    (other / "tokenizer.json").write_text("{}")
    assert "cannot be read" in said(*given, str(other))
    monkeypatch.setitem(sys.modules, "transformers", None)
    assert "concent-warp[florence2]" in said(*given, str(weights))
