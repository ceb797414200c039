# SPDX-FileCopyrightText: 2026 The g2_recon developers
# SPDX-License-Identifier: Apache-2.0
import pytest
import yaml

from g2_recon import config
from g2_recon.config import G2ReconConfig, LocalizationConfig, ReconstructionConfig, SimulationConfig
from g2_recon.errors import ConfigError

STAGES = [type(getattr(G2ReconConfig(), name)) for name in G2ReconConfig.model_fields] + [SimulationConfig]
EVERY_SETTING = [
    pytest.param(setting, id=f"{model.__name__}.{setting.name}")
    for model in STAGES
    for setting in config.settings(model)
]


@pytest.mark.parametrize("setting", EVERY_SETTING)
def test_every_setting_says_what_it_means(setting):
    assert len(setting.meaning) > 10


@pytest.mark.parametrize("setting", EVERY_SETTING)
def test_every_number_has_a_range_that_holds_its_default(setting):
    if setting.type in (int, float):
        assert setting.minimum <= setting.default <= setting.maximum


def test_dumped_settings_load_as_they_were(tmp_path):
    changed = G2ReconConfig(
        localization=LocalizationConfig(laser_pose=(0.1, 0, 0.3, 0, 0, 1e-7), max_range=12.5),
        reconstruction=ReconstructionConfig(mode="paper", seed=7),
    )
    file = tmp_path / "config.yaml"
    file.write_text(config.dump(changed))
    assert config.load(file) == changed


def test_what_a_file_leaves_out_keeps_its_default(tmp_path):
    file = tmp_path / "config.yaml"
    file.write_text("reconstruction:\n  theta: 2.5\n")
    loaded = config.load(file)
    assert loaded.reconstruction.theta == 2.5
    assert loaded.localization == LocalizationConfig()


def test_an_empty_file_means_defaults(tmp_path):
    file = tmp_path / "config.yaml"
    file.write_text("")
    assert config.load(file) == G2ReconConfig()


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("reconstruction:\n  theta: 99\n", "reconstruction.theta"),
        ("reconstruction:\n  thetta: 1\n", "thetta"),
        ("localisation: {}\n", "localisation"),
        ("localization:\n  max_range: .nan\n", "max_range"),
        ("localization:\n  laser_pose: [1, 2]\n", "six numbers"),
        ("localization:\n  min_range: 9\n  max_range: 5\n", "min_range must be smaller"),
        ("reconstruction:\n  mode: quick\n", "mode"),
        ("- a list\n", "settings"),
        ("a: b: c\n", "YAML"),
        ("1: 2\n", "settings"),
    ],
)
def test_a_wrong_file_is_refused_in_one_line_that_names_the_place(tmp_path, text, said):
    file = tmp_path / "config.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        config.load(file)
    assert said in str(error.value)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)


def test_a_missing_file_is_said(tmp_path):
    with pytest.raises(ConfigError, match="No such file"):
        config.load(tmp_path / "nowhere.yaml")


def test_a_dump_comments_each_setting_with_meaning_unit_and_range():
    text = config.dump(G2ReconConfig())
    assert (
        "# border neurons are joined when nearer than this many mean distances to lattice neighbors (0 to 10)" in text
    )
    assert "[m] (0.5 to 200)" in text
    assert yaml.safe_load(text)["reconstruction"]["theta"] == 1.8
