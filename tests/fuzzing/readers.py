"""All that cfplan reads, by name."""

from tests.fuzzing.files import FILES
from tests.fuzzing.links import LINKS
from tests.fuzzing.logs import LOGS

READERS = FILES | LOGS | LINKS
