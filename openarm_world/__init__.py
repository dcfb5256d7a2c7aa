# SPDX-License-Identifier: Apache-2.0
"""Objects in front of the robot, each with an id that lives from its first frame to its last; free of ROS.

Example:
    >>> from openarm_world import Objects, explain
    >>> objects = Objects()
    >>> objects, sight = objects.update(view, cloud, t_ns)  # doctest: +SKIP
    >>> sight.ids  # of the detections of the cloud  # doctest: +SKIP
    ('1', '2')
    >>> explain(objects.tracks[0].points, np.eye(4), view).left  # 0: it stands  # doctest: +SKIP
    0.002
"""

from typing import TYPE_CHECKING

from openarm_common.lazy import attach

if TYPE_CHECKING:
    from openarm_world.config import WorldConfig as WorldConfig
    from openarm_world.objects import Objects as Objects
    from openarm_world.objects import Sight as Sight
    from openarm_world.objects import Track as Track
    from openarm_world.shares import Shares as Shares
    from openarm_world.shares import explain as explain
    from openarm_world.shares import fit as fit
    from openarm_world.shares import view_of as view_of

__getattr__, __dir__ = attach(__name__, __file__)
