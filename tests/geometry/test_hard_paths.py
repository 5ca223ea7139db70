"""Hard paths that cannot be flown through are refused with the reason."""

import pytest
from hard_paths import hard_paths

from cfplan.errors import InputError


@pytest.mark.parametrize("case", hard_paths("path"))
def test_it_is_refused_with_the_reason(case):
    with pytest.raises(InputError, match=case.expect["path"]):
        case.path.check()
