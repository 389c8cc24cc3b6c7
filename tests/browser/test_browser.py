"""That the browser tells of faults: otherwise the other tests would prove nothing."""

import pytest


def test_a_bad_page_is_found_out(open_page, tmp_path):
    path = tmp_path / "bad.html"
    path.write_text(
        "<!DOCTYPE html><body><script>"
        "console.error('said');"
        "fetch('http://far.invalid/away').catch(() => { document.title = 'cut off' });"
        "throw new Error('thrown')"
        "</script>"
    )
    page = open_page(path.as_uri())
    page.wait_until("document.title === 'cut off'")
    assert page.requests() == [path.as_uri(), "http://far.invalid/away"]
    said, refused, thrown = page.complaints()
    assert said == "said"
    assert "ERR_NAME_NOT_RESOLVED" in refused
    assert "thrown" in thrown


def test_what_cannot_be_evaluated_is_an_error(open_page):
    with pytest.raises(AssertionError, match="nobody is not defined"):
        open_page("about:blank").evaluate("nobody.is()")


def test_an_address_that_cannot_be_opened_is_an_error(open_page):
    with pytest.raises(AssertionError, match="ERR_NAME_NOT_RESOLVED"):
        open_page("http://far.invalid/")
