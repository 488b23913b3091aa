"""Monte Carlo campaigns: is a filter consistent, and how good is it, over many runs of a world or of a log's replay."""

from kalmark.campaign.campaign import Campaign
from kalmark.campaign.replay import Replay
from kalmark.campaign.running import run_campaign, run_sweep
from kalmark.campaign.scoring import Scores
from kalmark.campaign.sweep import Sweep
from kalmark.campaign.sweep_cells import Cell, open_cells, open_scene

__all__ = ["Campaign", "Cell", "Replay", "Scores", "Sweep", "open_cells", "open_scene", "run_campaign", "run_sweep"]
