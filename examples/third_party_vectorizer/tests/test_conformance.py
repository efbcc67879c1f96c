"""What every vectorizer must keep; the scene's stop line gives it something to find."""

from hdmap_stop_line_example import StopLineExample

from hdmap_tools.testing.conformance import VectorizerConformance


class TestStopLineExample(VectorizerConformance):
    vectorizer = StopLineExample
