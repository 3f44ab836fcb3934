"""Every reader gives a value or one line that names the file, whatever lies under the name."""

from __future__ import annotations

import io
import json
import math
import os
import socket
import zipfile

import numpy as np
import pytest
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lagros_envs import reading
from lagros_envs.reading import Record, read_bytes, read_json, read_npz
from lagros_envs.tasks.spacecraft.scenarios import Scenario, preset_named

# pickles what is read, if anything unpickles it.
BOMB = b"cos\nsystem\n(S'touch pwned'\ntR."
READERS = {"json": read_json, "npz": read_npz, "scenario": Scenario.load, "record": Record.load}
FUZZ = settings(
    max_examples=60, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture]
)


@pytest.fixture(params=READERS)
def reader(request):
    return READERS[request.param]


def value_or_line(read, path):
    """Return what is read, or None where it is refused with a line that names the file."""
    try:
        return read(path)
    except ValueError as error:
        text = str(error)
    assert path.name in text
    assert "\n" not in text
    return None


def refused(read, path) -> str:
    """Return the one line with which a file is refused."""
    with pytest.raises(ValueError, match=r"^.+$") as error:
        read(path)
    text = str(error.value)
    assert "\n" not in text
    assert path.name in text
    assert len(text) < 1000
    return text


def test_what_is_no_file_is_refused_by_what_it_is(reader, tmp_path):
    folder = tmp_path / "folder"
    folder.mkdir()
    pipe = tmp_path / "pipe"
    os.mkfifo(pipe)
    listening = socket.socket(socket.AF_UNIX)
    listening.bind(str(tmp_path / "socket"))
    (tmp_path / "beneath").touch()
    assert "is a folder" in refused(reader, folder)
    assert "is a pipe, a device or a socket" in refused(reader, pipe)
    assert "is a pipe, a device or a socket" in refused(reader, tmp_path / "socket")
    listening.close()
    assert "cannot be read" in refused(reader, tmp_path / "beneath" / "file")
    assert "cannot be read" in refused(reader, tmp_path / ("x" * 300))
    with pytest.raises(ValueError, match=r"^'.*a.*b': embedded null byte$"):
        reader(tmp_path / "a\0b")
    loop = tmp_path / "loop"
    loop.symlink_to(loop)
    assert "cannot be read" in refused(reader, loop)
    for absent in (tmp_path / "absent", tmp_path / "no" / "folder"):
        with pytest.raises(FileNotFoundError, match="there is no file .*" + absent.name):
            reader(absent)


def test_a_file_is_read_to_a_limit(tmp_path):
    path = tmp_path / "large"
    path.write_bytes(b"[1, 2]")
    assert read_bytes(path, 6) == b"[1, 2]"
    assert "more than the 5 bytes" in refused(lambda file: read_bytes(file, 5), path)


JSON_REFUSED = {
    "empty": (b"", "it is empty"),
    "blank": (b" \n\t", "it is empty"),
    "binary": (bytes(range(256)), "not UTF-8"),
    "utf-16": ('{"a": 1}'.encode("utf-16"), "not UTF-8"),
    "truncated": (b'{"a": [1, 2', "Expecting"),
    "two values": (b"{} {}", "Extra data"),
    "brackets": (b"[" * 200_000, "nested too deeply"),
    "objects": (b'{"a":' * 200_000, "nested too deeply"),
    "NaN": (b'{"a": NaN}', "a is a number that is not finite"),
    "Infinity": (b"[-Infinity]", "[0] is a number that is not finite"),
    "1e400": (b"[1e400]", "[0] is a number that is not finite or too large"),
    "-1e400": (b"[-1e400]", "too large"),
    "10^400": (b"[1" + b"0" * 400 + b"]", "too large"),
    "10^309": (b"[1" + b"0" * 309 + b"]", "too large"),
    "10^5000": (b"[1" + b"0" * 5000 + b"]", "too large"),
    "in it": (b'{"a": {"b": [1, [2, NaN]]}}', "a.b[1][1] is a number that is not finite"),
    "twice": (b'{"a": 1, "b": 2, "a": 3}', "it states"),
    "comma": (b"[1,]", "Expecting|Illegal"),
    "quotes": (b"{'a': 1}", "Expecting|Illegal"),
    "control": (b'["a\nb"]', "Invalid control character"),
}


@pytest.mark.parametrize("name", JSON_REFUSED)
def test_what_is_not_json_is_refused_with_the_reason(name, tmp_path):
    path = tmp_path / "settings.json"
    data, reason = JSON_REFUSED[name]
    path.write_bytes(data)
    text = refused(read_json, path)
    assert any(part in text for part in reason.split("|")), text


@pytest.mark.parametrize(
    "value",
    [None, True, 0, -1.5, 1e308, 10**300, "ä\n🚀", [], {}, {"a": [{"b": None}]}],
    ids=range(10),
)
def test_all_that_json_can_say_is_read_as_json_reads_it(value, tmp_path):
    path = tmp_path / "value.json"
    path.write_text(json.dumps(value))
    assert read_json(path) == value
    path.write_bytes(b"\xef\xbb\xbf" + json.dumps(value, ensure_ascii=False).encode())
    assert read_json(path) == value


def npz(path, **arrays):
    with path.open("wb") as stream:
        np.savez_compressed(stream, **arrays)
    return path


def member(path, name, data, **options):
    with zipfile.ZipFile(path, "w", **options) as archive:
        archive.writestr(name, data)
    return path


def npy(header: str, data: bytes = b"") -> bytes:
    """Return an array's bytes under a header of any text."""
    text = header.encode("latin1")
    text += b" " * (-(len(text) + 11) % 64) + b"\n"
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text + data


def test_arrays_come_back_with_every_bit(tmp_path):
    arrays = {"a": np.arange(6.0).reshape(2, 3), "b": np.array("text"), "c": np.zeros((0, 2), "i2")}
    found = read_npz(npz(tmp_path / "ok.npz", **arrays), ("a", "c"))
    assert found.keys() == arrays.keys()
    for name, array in arrays.items():
        np.testing.assert_array_equal(found[name], array, strict=True)


HEADERS = {
    "object": "{'descr': '|O', 'fortran_order': False, 'shape': (1,), }",
    "too long": "{'descr': '<f8', 'fortran_order': False, 'shape': (1000000,), }",
    "enormous": "{'descr': '<f8', 'fortran_order': False, 'shape': (1152921504606846975,), }",
    "negative": "{'descr': '<f8', 'fortran_order': False, 'shape': (-5,), }",
    "token": "{'descr': '<f8', 'fortran_order': (, 'shape': (1,), }",
    "string": "{'descr': '<f8', 'fortran_order': False, 'shape': (1,), '''",
    "nested": "(" * 5000,
    "code": "__import__('os').system('touch pwned')",
    "long integer": "{'descr': '<f8', 'fortran_order': False, 'shape': (1L,), }",
    "empty": "",
}


@pytest.mark.parametrize("name", HEADERS)
def test_an_array_with_a_wrong_header_is_refused(name, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    refused(read_npz, member(tmp_path / "wrong.npz", "a.npy", npy(HEADERS[name], BOMB)))
    assert not (tmp_path / "pwned").exists()


def test_pickled_objects_are_refused_and_not_run(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    objects = np.array([{"a": 1}], dtype=object)
    buffer = io.BytesIO()
    np.savez(buffer, a=objects)
    (tmp_path / "objects.npz").write_bytes(buffer.getvalue())
    assert "allow_pickle" in refused(read_npz, tmp_path / "objects.npz")
    (tmp_path / "pickle.npz").write_bytes(BOMB)
    refused(read_npz, tmp_path / "pickle.npz")
    assert not (tmp_path / "pwned").exists()


def test_a_bomb_is_refused_before_it_expands(tmp_path):
    path = npz(tmp_path / "bomb.npz", a=np.zeros(1 << 24))
    assert path.stat().st_size < 1 << 18
    assert "would expand to" in refused(lambda file: read_npz(file, most=1 << 20), path)


def test_an_archive_that_is_no_npz_is_refused_or_lacks_the_array(tmp_path):
    np.save(tmp_path / "single.npy", np.zeros(3))
    refused(read_npz, tmp_path / "single.npy")
    path = member(tmp_path / "words.npz", "words.txt", "nothing")
    assert "has no array 'a'" in refused(lambda file: read_npz(file, ("a",)), path)
    path = npz(tmp_path / "other.npz", b=np.zeros(1))
    assert "has no array 'a'; it has ['b']" in refused(lambda file: read_npz(file, ("a",)), path)


def test_every_truncation_and_flipped_byte_of_an_npz_is_a_value_or_a_line(tmp_path):
    whole = npz(tmp_path / "whole.npz", a=np.arange(50.0), b=np.array("text")).read_bytes()
    path = tmp_path / "damaged.npz"
    rng = np.random.default_rng(0)
    for place in rng.integers(0, len(whole), 150):
        flipped = bytearray(whole)
        flipped[place] ^= 1 << int(rng.integers(8))
        for data in (bytes(flipped), whole[:place]):
            path.write_bytes(data)
            value_or_line(read_npz, path)


class TestRecord:
    """Entries by name and type."""

    RECORD = Record(
        {"n": 2, "x": 0.5, "t": "text", "l": [1, 2], "o": {"a": 1}, "e": [], "m": [[1, 2], [3, 4]]},
        "file.json",
    )

    def test_entries_of_the_right_type_are_returned(self):
        assert (self.RECORD.whole("n"), self.RECORD.number("x"), self.RECORD.number("n")) == (
            2,
            0.5,
            2.0,
        )
        assert (self.RECORD.text("t"), self.RECORD.list("l")) == ("text", [1, 2])
        assert self.RECORD.record("o").whole("a") == 1
        assert self.RECORD.array("m", (2, 2)).tolist() == [[1.0, 2.0], [3.0, 4.0]]
        assert self.RECORD.array("e", (None, 2)).shape == (0, 2)
        assert self.RECORD.array("e", (0,)).shape == (0,)
        assert self.RECORD.array("x").shape == ()

    @pytest.mark.parametrize(
        "value",
        [
            "0.5",
            True,
            None,
            {},
            [],
            [[1], [2, 3]],
            ["1"],
            [True],
            [None],
            math.nan,
            [math.inf],
            10**400,
        ],
        ids=range(12),
    )
    def test_what_is_no_number_is_refused_with_its_name(self, value):
        record = Record({"x": value}, "file.json")
        with pytest.raises(ValueError, match=r"^file\.json: 'x' .*"):
            record.number("x")
        with pytest.raises(ValueError, match=r"^file\.json: 'x' .*"):
            record.whole("x")
        with pytest.raises(ValueError, match=r"^file\.json: 'x' .*"):
            record.array("x", (2,))

    def test_missing_and_unknown_entries_are_named(self):
        for ask in (self.RECORD.number, self.RECORD.array, self.RECORD.text, self.RECORD.record):
            with pytest.raises(ValueError, match=r"^file\.json has no entry 'y'"):
                ask("y")
        with pytest.raises(ValueError, match=r"unknown entry 'x'"):
            self.RECORD.only(["n", "t", "l", "o", "e", "m"])
        with pytest.raises(ValueError, match=r"'t' is 'text' and must be 'other'"):
            self.RECORD.must("t", "other")
        with pytest.raises(ValueError, match=r"'format' is missing and must be 'other'"):
            self.RECORD.must("format", "other")
        with pytest.raises(ValueError, match=r"must be an object"):
            Record([1], "file.json")


JSON = st.recursive(
    st.none() | st.booleans() | st.integers() | st.floats() | st.text(max_size=5),
    lambda inner: (
        st.lists(inner, max_size=4) | st.dictionaries(st.text(max_size=5), inner, max_size=4)
    ),
    max_leaves=20,
)


@FUZZ
@given(data=st.binary(max_size=200))
def test_random_bytes_are_a_value_or_a_line(tmp_path, data):
    path = tmp_path / "random.json"
    path.write_bytes(data)
    for read in READERS.values():
        value_or_line(read, path)


@FUZZ
@given(value=JSON)
def test_random_json_is_the_value_or_a_line(tmp_path, value):
    path = tmp_path / "random.json"
    path.write_text(json.dumps(value))
    text = path.read_text()
    found = value_or_line(read_json, path)
    if "NaN" in text or "Infinity" in text:
        assert found is None
    else:
        assert found == value


SCENARIO = preset_named("paper").sample(np.random.default_rng(0)).to_dict()


@FUZZ
@given(name=st.sampled_from(["format", *SCENARIO]), value=JSON)
def test_a_scenario_with_any_entry_replaced_is_a_scenario_or_a_line(tmp_path, name, value):
    path = tmp_path / "scenario.json"
    path.write_text(json.dumps({"format": "lagros-scenario-1", **SCENARIO, name: value}))
    scenario = value_or_line(Scenario.load, path)
    if scenario is not None:
        assert np.all(np.isfinite(scenario.starts))
        assert isinstance(scenario.agent_radius, float)


def test_paths_are_named_so_that_they_can_be_printed():
    assert reading.named("a b.json") == "a b.json"
    assert reading.named("a\nb") == r"'a\nb'"
    assert reading.named("") == "''"
