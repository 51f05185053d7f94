"""The live playground: a ballbot to push, beside ghosts of itself under other controllers."""
