"""The reader of pickles that never executes code."""

import collections
import os
import pickle
import sys

import numpy as np
import pytest

from curate.detectors.recorded.plain_pickle import read_plain_pickle
from curate.errors import DataError
from curate.exporters.folder import write_pickle

HELD = [
    {
        "frame_id": np.str_("000001"),
        "name": np.array(["Car", "Van"]),
        "boxes": np.arange(14.0).reshape(2, 7),
        "turned": np.asfortranarray(np.arange(6, dtype=np.float32).reshape(2, 3)),
        "swapped": np.array([1.5, 2.5], dtype=">f8"),
        "objects": np.array(["a", None, 3], dtype=object),
        "none": np.zeros((0, 7), dtype=np.float32),
        "score": np.float32(0.5),
        "plain": (1, 2.5, "x", b"y", None, True, {1}, collections.OrderedDict(a=1)),
    }
]


class Runs:
    """Calls a function when it is unpickled with pickle.load."""

    def __init__(self, function, *arguments):
        self.call = function, arguments

    def __reduce__(self):
        return self.call


def written(path, value, protocol=4):
    """Return a pickle of a value."""
    path.write_bytes(pickle.dumps(value, protocol))
    return path


@pytest.mark.parametrize("protocol", range(2, 6))
def test_arrays_and_containers_are_read(tmp_path, protocol):
    """In every protocol, with their shapes and types."""
    [found] = read_plain_pickle(written(tmp_path / "a.pkl", HELD, protocol))
    [expected] = HELD
    assert list(found) == list(expected)
    for key, value in expected.items():
        if isinstance(value, np.ndarray):
            np.testing.assert_array_equal(found[key], value)
            assert found[key].dtype.newbyteorder("=") == value.dtype.newbyteorder("=")
        else:
            assert found[key] == value


def test_names_of_numpy_1_are_accepted(tmp_path):
    """Numpy 1 writes numpy.core where numpy 2 writes numpy._core."""
    content = pickle.dumps(np.arange(3.0), 2).replace(b"numpy._core", b"numpy.core")
    assert b"numpy.core.multiarray" in content
    (tmp_path / "a.pkl").write_bytes(content)
    assert read_plain_pickle(tmp_path / "a.pkl").tolist() == [0, 1, 2]


@pytest.mark.parametrize("protocol", range(5))
def test_a_pickle_with_code_is_rejected_and_not_executed(tmp_path, protocol):
    """pickle.load would create the folder; here the one-line error contains the rejected name."""
    path = written(tmp_path / "evil.pkl", [Runs(os.mkdir, str(tmp_path / "pwned"))], protocol)
    with pytest.raises(DataError) as caught:
        read_plain_pickle(path)
    assert not (tmp_path / "pwned").exists()
    assert f"evil.pkl: rejected: the pickle imports {os.mkdir.__module__}.mkdir;" in str(
        caught.value
    )
    assert "\n" not in str(caught.value)
    pickle.loads(path.read_bytes())  # proves that the pickle was armed
    assert (tmp_path / "pwned").exists()


def test_a_module_in_a_pickle_is_not_imported(tmp_path, monkeypatch):
    """Importing runs code too."""
    (tmp_path / "bad_module.py").write_text("import os\nos.mkdir('pwned')\n")
    monkeypatch.chdir(tmp_path)
    monkeypatch.syspath_prepend(tmp_path)
    (tmp_path / "a.pkl").write_bytes(b"cbad_module\nthing\n.")
    with pytest.raises(DataError, match=r"imports bad_module\.thing"):
        read_plain_pickle(tmp_path / "a.pkl")
    assert "bad_module" not in sys.modules
    assert not (tmp_path / "pwned").exists()


@pytest.mark.parametrize(
    "content",
    [
        b"cbuiltins\neval\n.",
        b"cbuiltins\ngetattr\n.",
        b"cnumpy\nload\n.",
        b"cnumpy.testing\nmeasure\n.",
        b"ctorch._utils\n_rebuild_tensor_v2\n.",
        b"\x80\x04\x8c\x05numpy\x8c\x11ndarray.__class__\x93.",
    ],
)
def test_other_names_are_rejected(tmp_path, content):
    """Functions of numpy that do more than hold values, and attributes of accepted names."""
    (tmp_path / "a.pkl").write_bytes(content)
    with pytest.raises(DataError, match="rejected: the pickle imports"):
        read_plain_pickle(tmp_path / "a.pkl")


@pytest.mark.parametrize(
    "content",
    [
        b"",
        b"no pickle",
        pickle.dumps(HELD)[:-40],
        b"cnumpy\nndarray\n)R.",  # calls an object that may only be referenced
        b"\x80\x02U\x01aQ.",  # a persistent id
    ],
)
def test_a_damaged_pickle_gives_a_one_line_error(tmp_path, content):
    """Never another exception."""
    (tmp_path / "a.pkl").write_bytes(content)
    with pytest.raises(DataError, match=r"a\.pkl: not a pickle, or a damaged one") as caught:
        read_plain_pickle(tmp_path / "a.pkl")
    assert "\n" not in str(caught.value)


def test_a_missing_file_is_reported(tmp_path):
    with pytest.raises(DataError, match=r"b\.pkl: no such file"):
        read_plain_pickle(tmp_path / "b.pkl")


def test_arrays_of_python_2_are_read(tmp_path):
    """Python 2 wrote the bytes of arrays and numbers as text, and knew two kinds of text."""
    content = (
        b"\x80\x02]q\x01(cnumpy.core.multiarray\n_reconstruct\nq\x02cnumpy\nndarray\nq\x03K\x00\x85"
        b"U\x01b\x87Rq\x04(K\x01K\x02\x85cnumpy\ndtype\nq\x05U\x02f8K\x00K\x01\x87Rq\x06"
        b"(K\x03U\x01<NNNJ\xff\xff\xff\xffJ\xff\xff\xff\xffK\x00tb\x89"
        b"U\x10" + np.array([1.5, -2.5]).tobytes() + b"tb"
        b"cnumpy.core.multiarray\nscalar\nh\x06U\x08" + np.float64(0.75).tobytes() + b"\x86R"
        b"U\x03Care."
    )
    (tmp_path / "a.pkl").write_bytes(content)
    array, number, name = read_plain_pickle(tmp_path / "a.pkl")
    assert array.tolist() == [1.5, -2.5]
    assert number == 0.75
    assert name == "Car"


def test_our_own_exports_are_read(tmp_path):
    """They call numpy.ndarray, which numpy before 2 has under the same name."""
    write_pickle(tmp_path / "a.pkl", [np.arange(6.0).reshape(2, 3), np.array(["Car", "Van"])])
    numbers, names = read_plain_pickle(tmp_path / "a.pkl")
    assert numbers.tolist() == [[0, 1, 2], [3, 4, 5]]
    assert names.tolist() == ["Car", "Van"]


@pytest.mark.parametrize(
    "arguments", [(10**12, "<f8", b""), ((2,), "O", b"1" * 16), ((1,), "x", b"")]
)
def test_an_array_that_is_claimed_is_not_allocated(tmp_path, arguments):
    """The content decides on the size; references are not read from bytes."""
    value = Runs(np.ndarray, *arguments)
    path = tmp_path / "a.pkl"
    path.write_bytes(pickle.dumps(value, 2))
    with pytest.raises(DataError):
        read_plain_pickle(path)
