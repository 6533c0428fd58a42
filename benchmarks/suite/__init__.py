"""How fast the parts of vggtjax are, beside what the machine could do at best: suite, memory, gpu-targets."""
