"""What the name of a policy means: files of any name, classes, and what is neither."""

from __future__ import annotations

import pytest

from lagros_policies.naming import (
    ModelFile,
    UserClass,
    is_code,
    listed_names,
    model_file,
    user_class,
)

ODD = [
    "my model.zip",
    "a:b.zip",
    "ppo:mine.zip",
    "a,b.zip",
    "-x.zip",
    "é中.zip",
    "UP.ZIP",
    "$x'.zip",
]
ODD += [" x.zip", "x\ny.zip", "ppo.zip", "tab\t,:.zip"]


@pytest.fixture(autouse=True)
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize("name", ODD)
@pytest.mark.parametrize("prefix", ["", "sac:", "PPO:"])
def test_a_model_may_be_called_as_the_system_allows(folder, name, prefix):
    (folder / name).touch()
    model = model_file(prefix + name)
    assert model is not None
    assert model.path.resolve() == (folder / name).resolve()
    assert model.algorithm == (prefix[:-1] or None)
    assert user_class(prefix + name) is None
    listed = listed_names(f"lqr,{prefix}{name}, lagros")
    assert listed == ("lqr", prefix + name, "lagros")


def test_a_model_without_the_ending_is_named_with_its_algorithm(folder):
    (folder / "model").touch()
    assert model_file("ppo:model") == ModelFile("ppo", folder.__class__("model"))
    assert model_file("model") is None
    assert model_file("mine:Good") is None


def test_a_model_that_is_not_there_is_a_file_all_the_same():
    assert model_file("no.zip") == ModelFile(None, model_file("no.zip").path)
    assert model_file("sac:no.zip").algorithm == "sac"
    assert model_file("x" * 300 + ".zip") is not None
    assert model_file("a\0b.zip") is not None


def test_a_class_is_named_by_module_and_name():
    assert user_class("a.b_1.c:Good") == UserClass("a.b_1.c", "Good")
    assert user_class("modul_ä:Klässe") == UserClass("modul_ä", "Klässe")
    assert user_class("lqr") is None


@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("../mine:Good", "write mine:Good and run lagros in .."),
        ("sub/mine.py:Good", "write mine:Good and run lagros in sub"),
        ("mine.py:Good", "write mine:Good"),
        ("..:x", "'..' is no module"),
        (":x", "'' is no module"),
        (".a:x", "'.a' is no module"),
        ("a b:x", "'a b' is no module"),
        ("a.b:", "write a.b:Class"),
        ("a:b c", "'b c' is no class"),
        ("a:b:c", "'b:c' is no class"),
        ("a\n:x", "is no module"),
    ],
)
def test_what_is_neither_is_explained(name, said):
    with pytest.raises(ValueError, match=r"^policy ") as caught:
        user_class(name)
    assert said in str(caught.value)
    assert "\n" not in str(caught.value)


def test_what_is_code_is_told_from_our_own_names():
    assert [is_code(name) for name in ("lqr", "mine:Good", "x.zip", "sac:x.zip")] == [
        *(False, True, True, True)
    ]


def test_lists_without_files_are_cut_at_their_commas():
    assert listed_names(" lqr ,, mine:Good,x.zip,") == ("lqr", "", "mine:Good", "x.zip", "")
    assert len(listed_names("a," * 5000)) == 5001
