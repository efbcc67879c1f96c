"""Tables of pairs as people write them."""

import numpy as np
import pytest

from hdmap_tools.calibration.pairs import read_pairs
from hdmap_tools.errors import CalibrationError

HEADER = "x_m,y_m,z_m,u_px,v_px\n"


def written(tmp_path, text, encoding="utf-8"):
    path = tmp_path / "pairs.csv"
    path.write_bytes(text.encode(encoding))
    return path


def test_columns_in_any_order_with_others_between(tmp_path):
    text = '# by hand\nv_px, name, u_px,x_m,y_m,z_m\n\n2.5,pole,1,10,20,30\r\n# later\n4,"a, b",3,-1e1,0,.5\n'
    pairs = read_pairs(written(tmp_path, text, "utf-8-sig"))
    np.testing.assert_array_equal(pairs.points, [[10, 20, 30], [-10, 0, 0.5]])
    np.testing.assert_array_equal(pairs.uv, [[1, 2.5], [3, 4]])
    assert pairs.lines.tolist() == [4, 6]


def test_a_header_alone_is_no_pair(tmp_path):
    assert len(read_pairs(written(tmp_path, HEADER))) == 0


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "is empty"),
        ("# only words\n", "is empty"),
        ("x_m,y_m,z_m,u_px\n1,2,3,4\n", "line 1: lacks .* v_px"),
        ("1,2,3,4,5\n1,2,3,4,5\n", "The first line names the columns"),
        ("x_m,x_m,y_m,z_m,u_px,v_px\n1,1,2,3,4,5\n", "repeats"),
        (HEADER + "1,2,3,4,5\n1,2,3,4\n", "line 3: 4 values, expected 5"),
        (HEADER + "\n1,2,3,4,five\n", "line 3: v_px is 'five'"),
        (HEADER + "1,2,nan,4,5\n", "line 2: z_m is 'nan'"),
        (HEADER + "1,inf,3,4,5\n", "line 2: y_m is 'inf'"),
        (HEADER + "1,,3,4,5\n", "line 2: y_m is ''"),
        (HEADER + '1,2,3,4,"5\n1,2,3,4,5\n', "not a CSV file|quoted"),
        (HEADER.replace(",", ";") + "1;2;3;4;5\n", "lacks"),
    ],
)
def test_tables_that_cannot_be_used(tmp_path, text, said):
    with pytest.raises(CalibrationError, match=said):
        read_pairs(written(tmp_path, text))


def test_files_that_are_no_table(tmp_path):
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_pairs(tmp_path / "none.csv")
    with pytest.raises(CalibrationError, match="cannot be read"):
        read_pairs(tmp_path)
    (tmp_path / "b.csv").write_bytes(b"\x89PNG\xff\xfe\x00")
    with pytest.raises(CalibrationError, match="not text"):
        read_pairs(tmp_path / "b.csv")
