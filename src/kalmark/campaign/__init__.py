"""Monte Carlo campaigns: is a filter consistent, and how good is it, over many runs of a world or of a log's replay."""

from kalmark.campaign.campaign import Campaign
from kalmark.campaign.replay import Replay
from kalmark.campaign.running import open_scene, run_campaign
from kalmark.campaign.scoring import Scores

__all__ = ["Campaign", "Replay", "Scores", "open_scene", "run_campaign"]
