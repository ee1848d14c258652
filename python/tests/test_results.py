"""What results look like and cost to look at."""

import numpy as np

import rowburst as rb


def test_a_report_is_short_in_a_terminal_and_whole_in_a_notebook(result):
    report = result.report()
    assert len(repr(report)) < 100 and "kB" in repr(report)
    assert str(report).startswith("<!") and report[:100] == str(report)[:100]
    assert "iframe" in report._repr_html_() and len(report._repr_html_()) > len(report)


def test_numbers_are_computed_once(capture, camera, psf, monkeypatch):
    result = rb.reconstruct(capture.frame, camera, psf, truth=capture.truth, prior="tv", max_iterations=5)
    first = result.numbers
    calls = []

    class Counted:
        def _json(self):
            calls.append(1)
            return "{}"

    monkeypatch.setattr(result, "_native", Counted())
    assert result.numbers == first and not calls
    first["tau"] = None
    assert result.numbers["tau"] is not None


def test_the_video_of_a_look_may_not_be_written_to(camera, psf, capture):
    look = rb.LiveView(camera, psf, prior="tv").next(capture.frame, time_budget_s=0.5)
    assert not look.video.flags.writeable
    np.testing.assert_equal(look.video.shape, camera.video_shape)
