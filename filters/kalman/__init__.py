"""Parts of the handwritten filters: beliefs, corrections, gates. Nothing here infers with GTSAM."""
