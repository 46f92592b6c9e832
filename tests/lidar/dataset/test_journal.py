"""The journal of finished frames, and the numbers of frames in a folder."""

from lidar.dataset.journal import Journal, frame_digest, read_journal
from lidar.dataset.layout import frame_numbers


def test_journal_keeps_the_last_entry_of_each_frame_in_order(tmp_path):
    path = tmp_path / "frames.csv"
    journal, digests = Journal(path), {frame: bytes([frame % 251]) * 64 for frame in (1_000, 7, 8)}
    journal.begin()
    for frame in (1_000, 7, 8, 7):
        journal.add("top", frame, points=frame + 1, digests=digests[frame])
    journal.add("front", 3, points=0, digests=b"")
    assert journal.file_digests("top", 8, count=2) == [digests[8][:32], digests[8][32:]]
    with path.open("a") as file:
        file.write("top,9,5\ntop,x,1,2\ntop,99999999999999999999,1,ab\n")  # cut off and damaged
    again = read_journal(path)
    assert len(again) == len(journal.entries) == 4
    table = again.of("top")
    assert table.frame.tolist() == [7, 8, 1_000]
    assert table.points.tolist() == [8, 9, 1_001]
    assert (table.row(8), table.row(9)) == (1, -1)
    assert again.of("none").frame.tolist() == []
    journal.close()
    assert path.read_text().splitlines() == [
        "sensor,frame,points,digest",
        "front,3,0,",
        *(f"top,{frame},{frame + 1},{frame_digest(digests[frame])}" for frame in (7, 8, 1_000)),
    ]


def test_frames_beyond_a_million_follow_in_order(tmp_path):
    for frame in (1_000_000, 999_999, 12):
        (tmp_path / f"{frame:06d}.laz").touch()
    for other in ("12.laz", "000013.laz.part", "notes.txt"):
        (tmp_path / other).touch()
    assert frame_numbers(tmp_path, ".laz").tolist() == [12, 999_999, 1_000_000]
    assert not len(frame_numbers(tmp_path / "none", ".laz"))
