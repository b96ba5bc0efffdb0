import numpy as np
import pytest
from scipy import stats

from ctsim import rng
from ctsim.kernels import noise_cpu, noise_reference

# Random123's published known answers for philox4x32-10: counter, key, result.
KNOWN = [
    ((0, 0, 0, 0), (0, 0), (0x6627E8D5, 0xE169C58D, 0xBC57AC4C, 0x9B00DBD8)),
    ((0xFFFFFFFF,) * 4, (0xFFFFFFFF,) * 2, (0x408F276D, 0x41C83B0E, 0xA20BC7C6, 0x6D5451FD)),
    (
        (0x243F6A88, 0x85A308D3, 0x13198A2E, 0x03707344),
        (0xA4093822, 0x299F31D0),
        (0xD16CFE09, 0x94FDCCEB, 0x5001E420, 0x24126EA1),
    ),
]


@pytest.mark.parametrize(("counter", "key", "answer"), KNOWN)
def test_philox_gives_the_published_answers(counter, key, answer):
    assert noise_reference.philox(*counter, *key) == answer
    arguments = [np.uint64(x) for x in (*counter, *key)]
    assert tuple(int(x) for x in noise_cpu.philox(*arguments)) == answer


def test_blocks_equal_the_reference_also_beyond_32_bit_pixel_numbers():
    key = rng.stream_key("scene", "photons", 3)
    fast, slow = np.empty((11, 4), np.uint32), np.empty((11, 4), np.uint32)
    for first, draw in ((0, 0), (2**32 - 5, 7)):
        noise_cpu.blocks(key, first, draw, fast)
        noise_reference.blocks(key, first, draw, slow)
        np.testing.assert_array_equal(fast, slow)


def test_a_number_depends_on_its_own_index_only():
    key = rng.stream_key("scene", "photons", 0)
    np.testing.assert_array_equal(rng.words(key, 40)[17:23], rng.words(key, 6, first=17))
    assert len(np.unique(rng.words(key, 1000))) > 3990


def test_keys_differ_whenever_a_part_of_the_name_differs():
    names = [("a", "b", 0), ("a", "b", 1), ("ab", "", 0), ("", "ab", 0), ("a", "b0", 0), ("a", "b", 10), ("a", "b1", 0)]
    assert len({int(rng.stream_key(*n)) for n in names}) == len(names)
    assert rng.stream_key("a", "b", 0) == rng.stream_key("a", "b", np.int64(0))


def test_a_key_never_changes():
    # BLAKE2b over each part behind its length (8 bytes, little endian), as any other program would compute it.
    import hashlib

    data = b"\x05" + bytes(7) + b"scene" + b"\x07" + bytes(7) + b"photons" + b"\x02" + bytes(7) + b"12"
    expected = int.from_bytes(hashlib.blake2b(data, digest_size=8).digest(), "little")
    assert int(rng.stream_key("scene", "photons", 12)) == expected


def test_uniform_and_normal_numbers_have_their_distributions():
    n = 200_000
    key = rng.stream_key("scene", "test", 0)
    u, z = rng.uniform(key, n), rng.normal(key, n, draw=1)
    assert u.min() > 0 and u.max() < 1
    for column in range(2):
        # Fixed streams: a right generator fails a 1e-4 test once in 1e4 streams, and these are known to pass.
        assert stats.kstest(u[:, column], "uniform").pvalue > 1e-4
        assert stats.kstest(z[:, column], "norm").pvalue > 1e-4
    # A correlation of independent numbers has standard deviation 1/sqrt(n); five of them.
    for pair in (u, z):
        assert abs(np.corrcoef(pair.T)[0, 1]) < 5 / np.sqrt(n)
        assert abs(np.corrcoef(pair[:-1, 0], pair[1:, 0])[0, 1]) < 5 / np.sqrt(n)
