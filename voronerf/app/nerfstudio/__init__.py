"""voronerf as a method of nerfstudio: ``ns-train voronerf``. It needs nerfstudio, and nothing else imports it.

r rays. Units and frames are nerfstudio's: its scenes are scaled so that the cameras lie in about -1..1.
"""
