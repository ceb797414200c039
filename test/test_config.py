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
        ("localization:\n  mode: localization\n", "mode localization needs a map"),
        ("localization:\n  method: paper\n  map: session.npz\n", "method paper cannot go on in a map"),
        ("localization:\n  max_range: 2020-13-45\n", "month"),
        ("localization:\n  max_range: " + "1" * 5000, "digits"),
        ("localization:\n  laser_pose: 0x" + "f" * 5000, "laser_pose"),
        ("[" * 20_000, "nested too deeply"),
        ("localization:\n  max_range: 5\nlocalization:\n  max_range: 6\n", "'localization' is there twice"),
        ("localization:\n  max_range: 5\n  max_range: 6\n", "'max_range' is there twice"),
        ("localization: &a {max_range: 5}\nregistration:\n  <<: *a\n", "merge"),
        ("localization:\n  laser_pose: [" + "x, " * 1000 + "x]\n", "and 996 more"),
        ("x" * 10_000 + ": 1\n", "xxx"),
    ],
    ids=lambda value: value[:30],
)
def test_a_wrong_file_is_refused_in_one_line_that_names_the_place(tmp_path, text, said):
    file = tmp_path / "config.yaml"
    file.write_text(text)
    with pytest.raises(ConfigError) as error:
        config.load(file)
    assert said in str(error.value)
    assert str(file) in str(error.value)
    assert "\n" not in str(error.value)
    assert len(str(error.value)) < 1000


def test_aliases_of_aliases_make_no_long_error(tmp_path):
    lists = [f"a{level}: &a{level} [{', '.join([f'*a{level - 1}'] * 10)}]" for level in range(1, 12)]
    file = tmp_path / "config.yaml"
    file.write_text("\n".join(["a0: &a0 [lol]", *lists, "localization: {max_range: *a11, laser_pose: *a11}"]))
    with pytest.raises(ConfigError) as error:
        config.load(file)
    assert len(str(error.value)) < 2000


def test_a_section_without_a_body_keeps_its_defaults(tmp_path):
    file = tmp_path / "config.yaml"
    file.write_text("localization:\n  # max_range: 5\nreconstruction:\n  theta: 2.5\n")
    assert config.load(file).localization == LocalizationConfig()


def test_an_unknown_section_without_a_body_is_refused(tmp_path):
    file = tmp_path / "config.yaml"
    file.write_text("localisation:\n")
    with pytest.raises(ConfigError, match="localisation"):
        config.load(file)


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
