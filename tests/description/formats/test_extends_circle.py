"""Robot files that extend one another in a circle, by whatever name."""

import pytest

from asbuilt import load_robot
from asbuilt.errors import DescriptionError


@pytest.mark.parametrize("name", ["R.TOML", "r.toml", "other.Toml"])
def test_a_circle_is_one_error(name, tmp_path):
    path = tmp_path / "r.toml"
    path.write_text(f'extends = "{name}"\n')
    if name != path.name:
        (tmp_path / name).symlink_to(path)
    with pytest.raises(DescriptionError, match="extend one another"):
        load_robot(path)
