"""Monte Carlo campaigns: is a filter consistent, and how good is it, over many runs of a world."""

from kalmark.campaign.campaign import Campaign
from kalmark.campaign.running import run_campaign
from kalmark.campaign.scoring import Scores

__all__ = ["Campaign", "Scores", "run_campaign"]
