"""The longest tests begin first: at the end of a run with several workers, none is left alone with a long one."""

import pytest

LONGEST = {
    "test_the_whole_line_at_smoke_scale",
    "test_lcnet_learns_the_light_directions_of_a_few_scenes",
    "test_a_handful_of_scenes_is_learned",
    "test_two_processes_give_the_losses_of_one",
}


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    items.sort(key=lambda item: item.name.partition("[")[0] not in LONGEST)
