"""Signed datasets: every flipped byte, missing, added or exchanged file is named."""

import json
import shutil

import numpy as np
import pytest
from helpers.programs import run_program
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st

from lidar.dataset.checksums import CHECKSUMS
from lidar.dataset.formats import FORMATS, read_cloud
from lidar.errors import DatasetError, InputError
from lidar.options.drive import DriveOptions
from lidar.simulation.drive import drive
from lidar.tools.integrity.digests import block_digests, merkle_root
from lidar.tools.integrity.keys import Hmac, read_secret, read_signer
from lidar.tools.integrity.watermark import WatermarkKey
from lidar.tools.sign import sign_dataset
from lidar.tools.verify import verify_dataset

MARK = WatermarkKey(b"0123456789abcdef")
HMAC = Hmac(b"fedcba9876543210")
RIG = """
name = "small"
[[lidar]]
name = "top"
preset = "vlp16"
translation = [1.2, 0.0, 1.9]
[[camera]]
name = "front"
translation = [3.6, 0.0, 0.8]
width = 16
height = 12
fov_deg = 90.0
rate_hz = 5.0
[[gnss]]
name = "gnss"
rate_hz = 5.0
"""


@pytest.fixture(scope="module")
def plain(scene, tmp_path_factory):
    folder = tmp_path_factory.mktemp("plain")
    (folder / "small.toml").write_text(RIG)
    formats = ("pcd", "csv", "laz")
    options = DriveOptions(rig=str(folder / "small.toml"), duration=0.4, seed=3, formats=formats, workers=1)
    drive(scene, folder / "a", options=options)
    return folder / "a"


@pytest.fixture(scope="module")
def signed(plain, tmp_path_factory):
    out = tmp_path_factory.mktemp("signed") / "a"
    sign_dataset(plain, out, watermark=MARK, signer=HMAC)
    return out


@pytest.fixture
def copy(signed, tmp_path):
    shutil.copytree(signed, tmp_path / "a")
    return tmp_path / "a"


def findings(folder, **options):
    return verify_dataset(folder, signer=HMAC, **options).chain.findings


def test_a_dataset_as_it_was_signed_is_intact(plain, signed):
    report = verify_dataset(signed, watermark=MARK, signer=HMAC)
    assert report.intact
    assert report.watermark.clouds == 4 * 3  # those of laz are taken back from the world frame
    assert report.watermark.wrong == 0
    assert report.chain.frames == 4 + 2
    assert report.chain.files == sum(
        path.is_file() and "integrity" not in path.parts and path.name != CHECKSUMS
        for path in signed.rglob("*")
    )
    moved = read_cloud(signed / "top/pcd/000001.pcd").xyz - read_cloud(plain / "top/pcd/000001.pcd").xyz
    assert 0.02 < np.abs(moved).max() <= 0.0261


def test_all_formats_have_the_marked_points(signed):
    exact = read_cloud(signed / "top/pcd/000002.pcd")
    np.testing.assert_allclose(read_cloud(signed / "top/csv/000002.csv").xyz, exact.xyz, atol=1e-4)
    np.testing.assert_allclose(np.linalg.norm(exact.xyz, axis=1), exact.range, atol=0.06)


@pytest.mark.full
def test_signing_again_gives_the_same_bytes(plain, signed, tmp_path):
    sign_dataset(plain, tmp_path / "b", watermark=MARK, signer=HMAC)
    for path in signed.rglob("*"):
        if path.is_file():
            assert path.read_bytes() == (tmp_path / "b" / path.relative_to(signed)).read_bytes()


@settings(max_examples=40, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(data=st.data())
def test_any_flipped_byte_is_named(copy, data):
    files = (path for path in copy.rglob("*") if path.is_file() and path.stat().st_size)
    paths = sorted(path for path in files if path.name != CHECKSUMS)  # which no key protects
    path = data.draw(st.sampled_from(paths))
    at = data.draw(st.integers(0, path.stat().st_size - 1))
    bits = data.draw(st.integers(1, 255))
    before = path.read_bytes()
    after = bytearray(before)
    after[at] ^= bits
    path.write_bytes(after)
    name = path.relative_to(copy).as_posix()
    found, refused = (), ""
    try:
        found = findings(copy)
    except (DatasetError, InputError) as error:  # metadata, or the signature, that cannot be read any more
        refused = str(error)
    path.write_bytes(before)
    if refused:
        assert path.suffix in (".json", ".csv")
        assert path.name in refused or name.startswith("integrity/")
        return
    assert any(finding.place == name for finding in found), (name, at, found)
    assert name.startswith("integrity/") or {finding.place for finding in found} == {name}


@pytest.mark.full
@settings(max_examples=20, deadline=None, suppress_health_check=[HealthCheck.function_scoped_fixture])
@given(row=st.integers(0, 2000), column=st.sampled_from(["x", "z", "intensity", "range", "label"]))
def test_the_block_of_a_changed_return_is_named(copy, row, column):
    path = copy / "top/pcd/000001.pcd"
    before = path.read_bytes()
    table = FORMATS["pcd"].read(path)
    row %= len(table["x"])
    table[column] = table[column].copy()
    table[column][row] += 1
    FORMATS["pcd"].write(path, table)
    (finding,) = findings(copy)
    path.write_bytes(before)
    assert finding.place == "top/pcd/000001.pcd"
    assert {block // 36 for block in finding.blocks} == {table["ring"][row]}
    assert len(finding.blocks) <= (2 if column == "x" else 1)


def test_missing_added_and_exchanged_frames_are_named(copy):
    pcd = copy / "top/pcd"
    (copy / "front/rgb/000001.png").unlink()
    first, third = (pcd / "000000.pcd").read_bytes(), (pcd / "000002.pcd").read_bytes()
    (pcd / "000000.pcd").write_bytes(third)
    (pcd / "000002.pcd").write_bytes(first)
    (pcd / "000009.pcd").write_bytes(first)
    (copy / "note.txt").write_text("new")
    found = {f.place: f.to_text() for f in findings(copy)}
    assert found == {
        "note.txt": "note.txt: added",
        "front/rgb/000001.png": "front/rgb/000001.png: missing",
        "top/pcd/000009.pcd": "top/pcd/000009.pcd: added",
        "top/pcd/000000.pcd": "top/pcd/000000.pcd: replaced (holds frame 2)",
        "top/pcd/000002.pcd": "top/pcd/000002.pcd: replaced (holds frame 0)",
    }
    marks = verify_dataset(copy, watermark=MARK).watermark
    assert {frame.file for frame in marks.frames if frame.absent} == {
        "top/pcd/000000.pcd",
        "top/pcd/000002.pcd",
    }


@pytest.mark.full
@pytest.mark.parametrize(
    "place",
    [
        "velodyne_9/000000.bin",
        "labels_x/000000.label",
        "samples/LIDAR_EXTRA/a.pcd.bin",
        "top/pcd_9/000000.pcd",
        "top/truth/000000.npz",  # the drive has no stages, and so no truth
        "top/truth/000000.pcd",
        "truth/gnss.csv",
        "gnss.truth.csv",
        "integrity/top/000000.pcd",
        "integrity/note.txt",
    ],
)
def test_any_file_that_is_not_signed_is_named(copy, place):
    (copy / place).parent.mkdir(parents=True, exist_ok=True)
    (copy / place).write_bytes(b"new")
    assert [f.to_text() for f in findings(copy)] == [f"{place}: added"]


def test_links_and_empty_folders_are_named(copy, tmp_path):
    outside = tmp_path / "outside"
    (copy / "top").rename(outside)
    (copy / "top").symlink_to(outside)
    (copy / "gnss.csv").rename(tmp_path / "gnss.csv")
    (copy / "gnss.csv").symlink_to(tmp_path / "gnss.csv")
    (copy / "more").mkdir()
    (copy / "extra").symlink_to(outside)
    assert {f.to_text() for f in findings(copy)} >= {
        f"top: link (leads to {outside})",
        f"gnss.csv: link (leads to {tmp_path / 'gnss.csv'})",
        f"extra: link (leads to {outside})",
        "more/: added",
    }


def test_data_with_links_are_not_signed_and_empty_folders_are(plain, tmp_path):
    shutil.copytree(plain, tmp_path / "a")
    (tmp_path / "a/more").mkdir()
    sign_dataset(tmp_path / "a", None, signer=HMAC)
    assert not findings(tmp_path / "a")
    (tmp_path / "a/more").rmdir()
    assert [f.to_text() for f in findings(tmp_path / "a")] == ["more/: missing"]
    (tmp_path / "a/more").symlink_to(tmp_path)
    with pytest.raises(DatasetError, match="more: is a link"):
        sign_dataset(tmp_path / "a", None, signer=HMAC, overwrite=True)


@pytest.mark.full
def test_truth_of_stages_is_not_signed(plain, tmp_path):
    out = tmp_path / "lossy"
    run_program("lidar", "apply", plain, "--stage", "dropped_packets:loss=0.1,burst=3", "-o", out)
    assert (out / "top/truth/000000.npz").is_file()
    sign_dataset(out, None, signer=HMAC)
    shutil.rmtree(out / "top/truth")
    assert not findings(out)


def test_a_frame_that_is_cut_out_of_data_and_list_is_noticed(copy):
    table = copy / "integrity/top.csv"
    lines = table.read_text().splitlines()
    table.write_text("\n".join([*lines[:2], *lines[3:]]) + "\n")
    for path in copy.rglob("000001.*"):
        if path.parts[-3] == "top" or path.parent.name == "top":
            path.unlink()
    texts = [f.to_text() for f in findings(copy)]
    assert any("integrity/top.csv: signed list was changed (from frame 2 on)" in text for text in texts)


@pytest.mark.full
def test_a_list_that_was_made_anew_needs_the_key(copy):
    sign_dataset(copy, None, signer=Hmac(b"the attacker's own"), overwrite=True)
    (finding,) = findings(copy)
    assert finding.what == "signature is not valid"


@pytest.mark.full
def test_lost_returns_are_found_by_the_watermark(signed, tmp_path):
    out = tmp_path / "lossy"
    run_program("lidar", "apply", signed, "--stage", "dropped_packets:loss=0.1,burst=3", "-o", out)
    report = verify_dataset(out, watermark=MARK)
    truth = {k: np.load(out / f"top/truth/{k:06d}.npz")["removed"] for k in range(4)}
    for frame in report.watermark.frames:
        assert len(truth[frame.frame])
        assert {place.kind for place in frame.places} <= {"removed"}
    assert {frame.frame for frame in report.watermark.frames} == {k for k, gone in truth.items() if len(gone)}


def test_ed25519_verifies_with_the_public_key(plain, tmp_path):
    ed25519 = pytest.importorskip("cryptography.hazmat.primitives.asymmetric.ed25519")
    serialization = pytest.importorskip("cryptography.hazmat.primitives.serialization")
    private = ed25519.Ed25519PrivateKey.from_private_bytes(bytes(range(32)))
    pem, raw = serialization.Encoding.PEM, serialization.PrivateFormat.PKCS8
    (tmp_path / "private.pem").write_bytes(private.private_bytes(pem, raw, serialization.NoEncryption()))
    info = serialization.PublicFormat.SubjectPublicKeyInfo
    (tmp_path / "public.pem").write_bytes(private.public_key().public_bytes(pem, info))
    sign_dataset(plain, tmp_path / "a", signer=read_signer(tmp_path / "private.pem"))
    public = read_signer(tmp_path / "public.pem")
    assert verify_dataset(tmp_path / "a", signer=public).intact
    with pytest.raises(InputError, match="a public key cannot sign"):
        sign_dataset(plain, tmp_path / "b", signer=public)
    path = tmp_path / "a/integrity/chain.json"
    document = json.loads(path.read_text())
    document["files"]["note.txt"] = "00" * 32
    path.write_text(json.dumps(document))
    assert not verify_dataset(tmp_path / "a", signer=public).intact


def test_without_cryptography_one_line_names_the_extra(tmp_path, monkeypatch):
    (tmp_path / "key.pem").write_text("-----BEGIN PRIVATE KEY-----\n")
    monkeypatch.setitem(__import__("sys").modules, "cryptography", None)
    monkeypatch.setitem(__import__("sys").modules, "cryptography.hazmat.primitives.serialization", None)
    with pytest.raises(Exception, match=r"it comes with: pip install 'geoscene\[security\]'"):
        read_signer(tmp_path / "key.pem")


@pytest.mark.parametrize(
    ("words", "says"),
    [
        (["sign", "PLAIN", "-o", "x"], "give --watermark, --chain or both"),
        (["sign", "PLAIN", "--watermark", "KEY"], "--watermark changes clouds; give a directory"),
        (["sign", "PLAIN", "--watermark", "SHORT", "-o", "x"], "a key of 2 bytes; give 16 or more"),
        (["sign", "PLAIN", "--watermark", "none", "-o", "x"], "none: cannot be read as a key"),
        (["sign", "PLAIN", "--watermark", "KEY", "--step", "0", "-o", "x"], "--step 0: give 0.0001 to 1"),
        (["sign", "SIGNED", "--watermark", "KEY", "-o", "x"], "has a watermark already"),
        (["verify", "PLAIN", "--chain", "KEY"], "is not signed; lidar sign --chain signs it"),
        (["verify", "SIGNED", "--watermark", "KEY", "--noise", "-1"], "--noise -1: give 0 to 1 metre"),
        (["verify", "SIGNED", "--watermark", "KEY", "--false-alarms", "0"], "--false-alarms 0: give more"),
    ],
)
def test_bad_input_is_one_line_and_nothing_is_written(words, says, plain, signed, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "KEY").write_text("00112233445566778899aabbccddeeff\n")
    (tmp_path / "SHORT").write_text("abcd")
    before = sorted(tmp_path.iterdir())
    done = run_program("lidar", *({"PLAIN": plain, "SIGNED": signed}.get(w, w) for w in words))
    assert done.returncode == 2
    assert says in done.stderr
    assert done.stderr.count("\n") == 1
    assert sorted(tmp_path.iterdir()) == before
    assert not (plain / "integrity").exists()


def test_verify_exits_with_1_and_prints_what_was_found(copy, tmp_path):
    (tmp_path / "key").write_text(HMAC.secret.hex())
    words = ("lidar", "verify", copy, "--chain", tmp_path / "key")
    done = run_program(*words)
    assert (done.returncode, "all as signed" in done.stdout) == (0, True)
    (copy / "gnss.csv").write_text("changed")
    done = run_program(*words)
    assert (done.returncode, "gnss.csv: changed" in done.stdout) == (1, True)
    document = json.loads(run_program(*words, "--json").stdout)
    assert (document["intact"], document["chain"]["findings"][0]["place"]) == (False, "gnss.csv")


def test_driving_again_removes_signatures(scene, tmp_path):
    options = DriveOptions(rig="vlp16", duration=0.2, workers=1)
    drive(scene, tmp_path / "a", options=options)
    sign_dataset(tmp_path / "a", None, signer=HMAC)
    assert verify_dataset(tmp_path / "a", signer=HMAC).intact
    drive(scene, tmp_path / "a", options=options, overwrite=True)
    assert not (tmp_path / "a/integrity").exists()


def test_secrets_are_hexadecimal_or_bytes(tmp_path):
    path = tmp_path / "key"
    path.write_text("00112233445566778899aabbccddeeff\n")
    assert read_secret(path) == bytes.fromhex("00112233445566778899aabbccddeeff")
    path.write_bytes(bytes(range(200, 232)))
    assert read_secret(path) == bytes(range(200, 232))


def test_order_of_rows_and_of_leaves():
    rng = np.random.default_rng(0)
    table = {
        **dict(zip("xyz", rng.normal(size=(3, 100)).astype(np.float32), strict=True)),
        "ring": rng.integers(0, 4, 100).astype(np.uint16),
        "column": np.arange(100, dtype=np.uint32),
    }
    order = rng.permutation(100)
    mixed = {name: column[order] for name, column in table.items()}
    assert block_digests(table).root == block_digests(mixed).root
    assert merkle_root([b"a", b"b", b"c"]) != merkle_root([b"b", b"a", b"c"])
    assert merkle_root([b"a", b"b"]) != merkle_root([merkle_root([b"a"]) + merkle_root([b"b"])])
