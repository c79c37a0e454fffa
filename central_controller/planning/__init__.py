"""Where to step: pendulum models, foot placement, trajectories of the swing foot, open-loop steps."""
