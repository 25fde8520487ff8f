"""Every format: any bytes are read or refused in one line."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from tests.tuning.formats.tables import texts, written
from tuning.formats.csv_table import CsvLayout, read_csv, write_csv
from tuning.formats.extra_p import read_extra_p
from tuning.formats.kernel_tuner import read_kernel_tuner, write_kernel_tuner
from tuning.formats.presentmon import read_presentmon
from tuning.formats.registry import read_table, recognised
from tuning.formats.t4 import read_t4
from tuning.formats.tracy import read_tracy
from tuning.timing_table import TimingTable
from vtfs.input_error import InputError


def test_an_unknown_format_is_refused(folder):
    with pytest.raises(InputError, match="--format xlsx"):
        read_table(written(folder, "a,ms\n1,2\n"), CsvLayout(), "xlsx")
    with pytest.raises(InputError, match="no format known"):
        recognised(written(folder, '{"hello": 1}'))


@settings(max_examples=200, deadline=None)
@given(
    content=st.one_of(
        st.binary(max_size=60), texts.map(str.encode), st.text("\"',;\n\r{}[]:1a.-", max_size=40).map(str.encode)
    )
)
def test_any_bytes_are_read_or_refused(folder, content):
    path = written(folder, content)
    for reader in (read_csv, read_presentmon, read_tracy, read_kernel_tuner, read_t4, read_extra_p):
        try:
            table = reader(path)
        except InputError as error:
            assert "\n" not in str(error)
        else:
            assert len(table) > 0


@pytest.mark.parametrize(("write", "name"), [(write_csv, "time_ms"), (write_kernel_tuner, "times")])
def test_a_column_with_the_name_of_a_field_is_not_overwritten(folder, write, name):
    with pytest.raises(InputError, match=f"`{name}`"):
        write(folder / "t", TimingTable({name: np.array([8.0])}, {}, ((1.0,),)))
