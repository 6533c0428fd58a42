"""VGGT as pure functions: backbone -> aggregator -> camera head and dense heads. linen modules are its leaves."""
