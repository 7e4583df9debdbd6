"""Pictures for people: videos of the robot and learning curves of a run."""
