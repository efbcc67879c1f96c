"""Maps in S3: what is wrong with it is said in one line and soon; nothing is half replaced."""

import datetime
import socket
import threading
import time

import pytest

from hdmap_tools.errors import OutputExistsError, StoreError
from hdmap_tools.fusion import map_repository
from hdmap_tools.fusion.map_location import S3Location
from hdmap_tools.fusion.map_repository import discard_branch, is_map_there, publish
from hdmap_tools.fusion.semantic_map import SemanticMap
from hdmap_tools.unfinished_map import map_when_done, resumable_map
from tests.s3_server import CREDENTIALS, s3_server, use

from .builders import counts_of, frames_of, meta

FIRST, SECOND = counts_of(frames_of(1, 2)), counts_of(frames_of(2, 3))


@pytest.fixture
def place(s3, request):
    """For a map of this test alone."""
    return S3Location("maps", "".join(c if c.isalnum() else "-" for c in request.node.name))


def made(location, counts=FIRST, drive="monday"):
    semantic_map = SemanticMap.create(location, meta())
    semantic_map.add(counts, drive, segment=0)
    return semantic_map


@pytest.fixture
def within_seconds():
    """Whatever a test does ends within a time that a person waits."""
    before = time.monotonic()
    yield
    assert time.monotonic() - before < 10


def says_once(raised, *words):
    told = str(raised.value)
    assert "\n" not in told
    for word in words:
        assert word in told


def test_what_is_stored_comes_back_exactly(place):
    made(place).add(SECOND, "tuesday")
    opened = SemanticMap.open(place)
    assert opened.read().equals(counts_of(frames_of(1, 2) + frames_of(2, 3)))
    assert SemanticMap.open(place, opened.history()[1].id).read().equals(FIRST)
    with pytest.raises(OutputExistsError):
        SemanticMap.create(place, meta())


def test_where_nothing_is(place):
    assert not is_map_there(place)
    with pytest.raises(StoreError, match="found nothing"):
        SemanticMap.open(place)


@pytest.mark.usefixtures("within_seconds")
def test_a_bucket_that_is_not_there(s3):
    place = S3Location("no-such-bucket", "map")
    for asking in (SemanticMap.open, lambda p: SemanticMap.create(p, meta())):
        with pytest.raises(StoreError) as raised:
            asking(place)
        says_once(raised, "no bucket 'no-such-bucket'", s3.url)


@pytest.mark.usefixtures("within_seconds")
def test_no_credentials(place, monkeypatch):
    for name in CREDENTIALS:
        monkeypatch.delenv(name)
    with pytest.raises(StoreError) as raised:
        SemanticMap.open(place)
    says_once(raised, "No credentials", "AWS_ACCESS_KEY_ID", str(place))


@pytest.mark.usefixtures("within_seconds")
def test_an_endpoint_that_is_not_there(place, monkeypatch):
    with socket.socket() as taken:
        taken.bind(("127.0.0.1", 0))  # and does not listen
        url = f"http://127.0.0.1:{taken.getsockname()[1]}"
        monkeypatch.setenv("AWS_ENDPOINT_URL", url)
        with pytest.raises(StoreError) as raised:
            SemanticMap.open(place)
    says_once(raised, "Nothing answers", url, "refused", "AWS_ENDPOINT_URL")


@pytest.mark.usefixtures("within_seconds")
def test_an_endpoint_that_never_answers(place, monkeypatch):
    monkeypatch.setattr(map_repository, "_ANSWERS_WITHIN_S", 0.5)
    with socket.create_server(("127.0.0.1", 0)) as silent:
        monkeypatch.setenv("AWS_ENDPOINT_URL", f"http://127.0.0.1:{silent.getsockname()[1]}")
        with pytest.raises(StoreError) as raised:
            SemanticMap.open(place)
    says_once(raised, "did not answer within 0.5 s", str(place))


@pytest.mark.parametrize(
    ("url", "says"),
    [
        ("127.0.0.1:9000", "expected http://HOST:PORT"),
        ("http://127.0.0.1:port", "Nothing answers"),
        ("http://", "Nothing answers"),
    ],
)
def test_an_endpoint_that_is_no_address(place, monkeypatch, url, says):
    monkeypatch.setenv("AWS_ENDPOINT_URL", url)
    with pytest.raises(StoreError) as raised:
        SemanticMap.open(place)
    says_once(raised, says, url)


def test_the_endpoint_of_s3_goes_before_that_of_all_services(place, s3, monkeypatch):
    monkeypatch.setenv("AWS_ENDPOINT_URL", "nonsense")
    monkeypatch.setenv("AWS_ENDPOINT_URL_S3", s3.url)
    assert not is_map_there(place)


@pytest.mark.usefixtures("within_seconds")
def test_no_permission(place, s3):
    stored = made(place)
    with s3.asking_for_rights():
        for asking in (SemanticMap.open, lambda p: SemanticMap.create(p, meta())):
            with pytest.raises(StoreError) as raised:
                asking(place)
            says_once(raised, "refuses access", str(place))
        with pytest.raises(StoreError) as raised:
            stored.add(SECOND, "tuesday")
        says_once(raised, "Could not commit", str(place), "as it was before")
        with pytest.raises(StoreError):  # not a damaged tile: nothing was learned of it
            stored.damaged_tiles()
    assert SemanticMap.open(place).read().equals(FIRST)


@pytest.mark.slow
def test_a_server_that_goes_away(monkeypatch):
    """What the library retries ends, after about half a minute."""
    with s3_server() as server:
        use(server, monkeypatch)
        stored = made(S3Location("maps", "map"))
    before = time.monotonic()
    with pytest.raises(StoreError) as raised:
        stored.add(SECOND, "tuesday")
    assert time.monotonic() - before < 90
    says_once(raised, "Could not commit", "s3://maps/map")


def test_a_map_takes_the_place_of_another_at_once(place, s3, monkeypatch):
    monkeypatch.setattr(map_repository, "_CLOCKS_DIFFER_BY", datetime.timedelta(0))
    made(place)
    before = set(s3.keys(place.prefix))
    time.sleep(1.1)  # objects carry whole seconds
    with map_when_done(place, overwrite=True) as begun:
        made(begun, SECOND, "tuesday")
        assert SemanticMap.open(place).read().equals(FIRST)
    replaced = SemanticMap.open(place)
    assert replaced.read().equals(SECOND)
    assert [version.message for version in replaced.history()] == ["Add tuesday", "Empty map"]
    assert not replaced.damaged_tiles()
    left = {key for key in before & set(s3.keys(place.prefix)) if not key.startswith("refs/")}
    assert len(left) == 1  # the first, empty commit


def test_an_error_leaves_the_earlier_map(place, s3):
    made(place)

    def fails():
        with map_when_done(place, overwrite=True) as begun:
            made(begun, SECOND)
            raise StoreError("No.")

    with pytest.raises(StoreError, match=r"No\."):
        fails()
    assert SemanticMap.open(place).read().equals(FIRST)
    assert [key for key in s3.keys(place.prefix) if key.startswith("refs/")] == [
        "refs/branch.main/ref.json"
    ]


def test_a_map_that_was_changed_meanwhile_is_not_replaced(place):
    made(place)

    def meddled():
        with map_when_done(place, overwrite=True) as begun:
            made(begun, SECOND)
            SemanticMap.open(place).add(SECOND, "tuesday")

    with pytest.raises(OutputExistsError, match="in the meantime"):
        meddled()
    assert set(SemanticMap.open(place).drives) == {"monday", "tuesday"}


PLAN = {"drive": "monday", "network": "one"}


def build(place, *, overwrite=False, resume=True):
    return resumable_map(place, PLAN, overwrite=overwrite, resume=resume)


def test_killed_as_it_began(place):
    """After the repository was made, before its first commit."""
    map_repository.make_repository(place.on_branch("unfinished"))
    with pytest.raises(StoreError, match="not finished"):
        SemanticMap.open(place)
    with build(place) as work:
        assert not is_map_there(work.location)
        made(work.location)
    assert SemanticMap.open(place).read().equals(FIRST)


def test_killed_when_it_had_been_published(place):
    """The branch is still there: the next build of that map begins anew."""
    begun = place.on_branch("unfinished")
    made(begun)
    publish(begun, None)
    repository = map_repository.open_repository(place)
    repository.create_branch("unfinished", repository.lookup_branch("main"))
    with pytest.raises(OutputExistsError, match="--overwrite"), build(place):
        pass
    with build(place, overwrite=True) as work:
        assert not is_map_there(work.location)
        made(work.location, SECOND)
    assert SemanticMap.open(place).read().equals(SECOND)


def test_two_who_finish_at_once(place):
    begun = place.on_branch("unfinished")
    made(begun)
    publish(begun, None)
    made(begun, SECOND)
    with pytest.raises(OutputExistsError, match="in the meantime"):
        publish(begun, None)
    assert SemanticMap.open(place).read().equals(FIRST)
    discard_branch(begun)
    discard_branch(begun)  # not there: nothing to do
    discard_branch(S3Location("maps", "nothing-here", "unfinished"))


def test_writers_of_many_threads_lose_nothing(place):
    """Of two commits at once one is refused, and can be done again."""
    made(place)

    def add(number):
        while True:
            try:
                SemanticMap.open(place).add(counts_of(frames_of(number, 1)), f"drive-{number}")
            except StoreError:
                continue
            return

    threads = [threading.Thread(target=add, args=(number,)) for number in (5, 6, 7)]
    for thread in threads:
        thread.start()
    for thread in threads:
        thread.join()
    whole = counts_of(frames_of(1, 2) + frames_of(5, 1) + frames_of(6, 1) + frames_of(7, 1))
    assert SemanticMap.open(place).read().equals(whole)
