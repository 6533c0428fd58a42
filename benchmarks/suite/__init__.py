"""Speed and memory of the parts of vggtjax, compared with the machine's best."""
