"""The layouts that scenes are exported to and imported from; a new one is a module and a line here."""

from collections.abc import Mapping

from render.exchange.layouts.custom_layout import Custom
from render.exchange.layouts.diligent_layout import Diligent
from render.exchange.layouts.layout_base import Layout
from render.exchange.layouts.psfcn_layout import PsFcn
from render.exchange.layouts.unips_layout import UniPs

LAYOUTS: Mapping[str, Layout] = {"psfcn": PsFcn(), "custom": Custom(), "diligent": Diligent(), "unips": UniPs()}
