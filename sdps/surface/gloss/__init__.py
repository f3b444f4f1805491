"""How a surface shines, as glTF and relightable pictures tell it."""
