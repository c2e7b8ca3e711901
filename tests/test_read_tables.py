"""Tables that people write: one reader for captions, paths and points, whatever the program that saved them."""

import numpy as np
import pytest
from builders import refused

from f3amd_lib.ground.tables import read_text_table
from f3amd_lib.motion.root_paths import read_path_csv
from f3amd_lib.text.data.captioned_folder import read_caption_table

PLAIN = 'file,caption\ngehe_ü.bvh,a person walks\nb/c.bvh,"walks, then stops"\n'
HABITS = {
    "none": lambda text: text.encode(),
    "byte order mark": lambda text: text.encode("utf-8-sig"),
    "UTF-16": lambda text: text.encode("utf-16"),
    "line ends of Windows": lambda text: text.replace("\n", "\r\n").encode(),
    "line ends of an old Mac": lambda text: text.replace("\n", "\r").encode(),
    "semicolons": lambda text: text.replace(",", ";").replace("walks; then", "walks, then").encode(),
    "tabs": lambda text: text.replace(",", "\t").replace("walks\t then", "walks, then").encode(),
    "Excel's own hint": lambda text: f"sep=,\n{text}".encode(),
    "headings": lambda text: text.replace("file,caption", ' File , "CAPTION"').encode(),
    "blank rows and columns": lambda text: text.replace("\n", ",,\n,,\n\n").encode(),
    "a column of numbers": lambda text: "".join(f",{line}\n" for line in text.splitlines()).encode(),
    "decomposed letters": lambda text: text.replace("ü", "u\u0308").encode(),
    "folders of Windows": lambda text: text.replace("b/c.bvh", "C:\\takes\\b\\c.BVH").encode(),
    "a line break": lambda text: text.replace("walks, then", "walks,\nthen").encode(),
    "a blank before quotes": lambda text: text.replace(',"', ', "').encode(),
}  # fmt: skip


@pytest.mark.parametrize("habit", HABITS)
def test_captions_are_the_same_whoever_saved_the_table(tmp_path, habit):
    path = tmp_path / "captions.csv"
    path.write_bytes(HABITS[habit](PLAIN))
    assert read_caption_table(path) == {"gehe_ü": ("a person walks",), "c": ("walks, then stops",)}


@pytest.mark.parametrize(
    "bad, line",
    [
        ("file,caption\na,b\n\nplain.bvh,walks, then stops\n", 4),
        ("file;caption\na;b\nplain.bvh\n", 3),
        ("file,caption,caption\na,b,c\n", 1),
        ('file,caption\na,"b" c\n', 2),
        ("name,text\na,b\n", 1),
    ],
)
def test_a_table_without_a_plain_meaning_is_refused_with_its_line(tmp_path, bad, line):
    path = tmp_path / "t.csv"
    path.write_text(bad)
    refused(f"t.csv: line {line}:", read_text_table, path, "file,caption", others=True)


def test_a_path_has_decimal_commas_where_semicolons_part_it(tmp_path):
    path = tmp_path / "path.csv"
    path.write_text("Z;X\n0,5;1,25\n\n0,6;1,25\n", encoding="utf-16")
    np.testing.assert_array_equal(read_path_csv(path).position, [[1.25, 0.5], [1.25, 0.6]])


@pytest.mark.parametrize("rows, kept", [(10, 9), (3, 0)])
def test_one_row_without_a_caption_among_many_is_left_out(tmp_path, caplog, rows, kept):
    path = tmp_path / "captions.csv"
    path.write_text("file,caption\nempty,\n" + "".join(f"take{k},walks\n" for k in range(rows - 1)))
    if not kept:
        return refused("1 of 3 records are broken.*line 2", read_caption_table, path)
    assert len(read_caption_table(path)) == kept and "1 of 10 records are broken" in caplog.text
