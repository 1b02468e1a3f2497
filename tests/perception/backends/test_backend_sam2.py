"""SAM 2 with random weights of a tiny network, loaded as a user's are."""

from __future__ import annotations

import json

import numpy as np
import pytest

import concent_warp as cw

transformers = pytest.importorskip("transformers", reason="needs pip install 'concent-warp[sam2]'")
SIZE = 64
"""Edge of the network's images [px]."""


@pytest.fixture(scope="module")
def weights(tmp_path_factory):
    """Return a folder with a checkpoint of a network with the parts of SAM 2, each as small as it may be."""
    import torch

    backbone = {
        "model_type": "sam2_hiera_det_model", "hidden_size": 8, "num_attention_heads": 1, "image_size": [SIZE, SIZE],
        "blocks_per_stage": [1, 1, 2, 1], "embed_dim_per_stage": [8, 16, 32, 64], "global_attention_blocks": [3],
        "num_attention_heads_per_stage": [1, 1, 2, 2], "window_size_per_stage": [4, 2, 4, 2],
        "window_positional_embedding_background_size": [2, 2],
    }  # fmt: skip
    vision = {
        "model_type": "sam2_vision_model", "backbone_config": backbone, "backbone_channel_list": [64, 32, 16, 8],
        "backbone_feature_sizes": [[16, 16], [8, 8], [4, 4]], "fpn_hidden_size": 128,
    }  # fmt: skip
    config = transformers.Sam2VideoConfig(
        vision_config=vision, image_size=SIZE, num_maskmem=3,
        prompt_encoder_config={"hidden_size": 128, "image_size": SIZE, "patch_size": 16},
        mask_decoder_config={
            "hidden_size": 128, "mlp_dim": 32, "num_attention_heads": 2, "iou_head_hidden_dim": 32,
            "num_hidden_layers": 1,
        },
        memory_attention_hidden_size=128, memory_attention_num_layers=1, memory_attention_feed_forward_hidden_size=32,
        memory_attention_rope_feat_sizes=[4, 4], memory_encoder_hidden_size=128, memory_encoder_output_channels=64,
        mask_downsampler_embed_dim=128, memory_fuser_embed_dim=128, memory_fuser_intermediate_dim=32,
    )  # fmt: skip
    torch.manual_seed(0)
    folder = tmp_path_factory.mktemp("sam2")
    model = transformers.Sam2VideoModel(config)
    # Where a network holds the object to be absent, it says nothing of its pixels; this one never does.
    torch.nn.init.constant_(model.mask_decoder.pred_obj_score_head.proj_out.bias, 10.0)
    model.save_pretrained(folder)
    return folder


@pytest.fixture(scope="module")
def frames():
    rgb = np.random.default_rng(0).integers(0, 255, (24, 48, 80, 3), dtype=np.uint8)
    return cw.CameraFrames(rgb, np.zeros(rgb.shape[:3], np.float32))


PROMPT = cw.MaskPrompt(0, np.array([[30.0, 20.0]]), np.array([20.0, 10.0, 40.0, 30.0]), np.array([[70.0, 40.0]]))


def test_masks_are_those_of_the_whole_video_at_once(weights, frames):
    import torch

    masker = cw.Sam2Masker(weights, device="cpu")
    short = frames.part(0, 5)
    found = masker.masks(short, {"block": PROMPT})["block"]
    assert found.shape == (5, 48, 80)
    model = masker._model
    video = torch.cat([masker._prepared(image) for image in short.rgb])
    session = transformers.Sam2VideoInferenceSession(video=video, video_height=48, video_width=80, dtype=torch.float32)
    scale = np.array([SIZE / 80, SIZE / 48])
    pixels = np.array([[20.0, 10.0], [40.0, 30.0], [30.0, 20.0], [70.0, 40.0]])
    inputs = {
        "point_coords": torch.tensor((pixels + 0.5) * scale - 0.5, dtype=torch.float32)[None, None],
        "point_labels": torch.tensor([2, 3, 1, 0], dtype=torch.int32)[None, None],
    }
    session.add_point_inputs(session.obj_id_to_idx(1), 0, inputs)
    session.obj_with_new_inputs = [1]
    for result in model.propagate_in_video_iterator(session, start_frame_idx=0):
        logits = torch.nn.functional.interpolate(result.pred_masks, (48, 80), mode="bilinear", align_corners=False)
        expected = (logits[0, 0] > 0).numpy()
        assert (found[result.frame_idx] == expected).mean() > 0.999
    assert 0 < found[1:].mean() < 1


def test_frames_before_the_prompt_are_those_of_the_reversed_video(weights, frames):
    masker = cw.Sam2Masker(weights, device="cpu")
    part = frames.part(0, 4)
    back = cw.CameraFrames(part.rgb[::-1], part.depth)
    last = cw.MaskPrompt(3, PROMPT.points, PROMPT.box, PROMPT.outside)
    found = masker.masks(part, {"block": last})["block"]
    np.testing.assert_array_equal(found, masker.masks(back, {"block": PROMPT})["block"][::-1])


def test_what_is_forgotten_is_no_longer_looked_at(weights, frames):
    shortest = cw.Sam2MaskerCfg(memory=17)
    found = cw.Sam2Masker(weights, shortest, device="cpu").masks(frames, {"block": PROMPT})["block"]
    every = cw.Sam2Masker(weights, device="cpu").masks(frames, {"block": PROMPT})["block"]
    np.testing.assert_array_equal(found, every)


def test_an_object_that_the_network_holds_to_be_absent_has_an_empty_mask(weights, frames):
    never = cw.Sam2MaskerCfg(min_presence=100)
    assert not cw.Sam2Masker(weights, never, device="cpu").masks(frames.part(0, 2), {"block": PROMPT})["block"].any()


def test_folders_that_hold_no_sam2_are_refused(weights, tmp_path):
    with pytest.raises(cw.ConcentError, match="no such folder"):
        cw.Sam2Masker(tmp_path / "gone")
    with pytest.raises(cw.ConcentError, match=r"no config\.json"):
        cw.Sam2Masker(tmp_path)
    (tmp_path / "config.json").write_text('{"model_type": "bert"}')
    with pytest.raises(cw.ConcentError, match="expected sam2_video, found bert"):
        cw.Sam2Masker(tmp_path)
    (tmp_path / "config.json").write_text((weights / "config.json").read_text())
    with pytest.raises(cw.ConcentError, match=r"cannot be loaded.*model\.safetensors"):
        cw.Sam2Masker(tmp_path)


def test_a_checkpoint_with_missing_weights_is_refused(weights, tmp_path):
    from safetensors.numpy import load_file, save_file

    tensors = load_file(weights / "model.safetensors")
    dropped = next(name for name in tensors if name.startswith("memory_attention"))
    del tensors[dropped]
    save_file(tensors, tmp_path / "model.safetensors", metadata={"format": "pt"})
    (tmp_path / "config.json").write_text(json.dumps(json.loads((weights / "config.json").read_text())))
    with pytest.raises(cw.ConcentError, match="weights are missing"):
        cw.Sam2Masker(tmp_path)
