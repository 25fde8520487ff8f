import pytest

from reports import number_text


@pytest.mark.parametrize(
    ("value", "text"),
    [(0, "0"), (0.01234, "0.0123"), (1.0, "1.00"), (12.345, "12.3"), (99.96, "100"), (999.4, "999"), (2110.4, "2,110")],
)
def test_three_digits_without_an_exponent(value, text):
    assert number_text.digits(value) == text


@pytest.mark.parametrize(
    ("ms_per_op", "text"),
    [(2.0, "2.00\u00a0ms"), (4.2e-3, "4.20\u00a0µs"), (1.87e-6, "1.87\u00a0ns"), (5e-8, "50.0\u00a0ps"), (0.0, "0")],
)
def test_a_price_has_the_unit_that_needs_no_exponent(ms_per_op, text):
    assert number_text.cost(ms_per_op) == text


@pytest.mark.parametrize(
    ("error", "text"), [(None, "–"), (0.0, "exact"), (1.9e-5, "exact"), (2e-5, "2.0e-5"), (2.4e-4, "2.4e-4")]
)
def test_an_error_that_is_only_rounding_is_called_exact(error, text):
    assert number_text.error(error) == text


@pytest.mark.parametrize(
    ("ends", "text"), [((91.42, 94.4), "91.4 to 94.4"), ((0.5, 12.0), "0.500 to 12.000"), ((0.0, 120.0), "0 to 120")]
)
def test_both_ends_of_an_interval_have_the_same_decimals(ends, text):
    assert number_text.interval(*ends) == text


@pytest.mark.parametrize(("share", "text"), [(0.0523, "5.2\u00a0%"), (0.44, "44\u00a0%"), (None, "–")])
def test_percent(share, text):
    assert number_text.percent(share) == text


@pytest.mark.parametrize(("value", "text"), [(0.0, "0"), (0.02, "0.02"), (32, "32"), ("float16", "float16")])
def test_a_setting_has_no_needless_decimals(value, text):
    assert number_text.setting(value) == text
