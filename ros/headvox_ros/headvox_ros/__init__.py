"""headvox on ROS 2: nodes that turn depth images and point clouds into heads.

What needs no ROS is in ``headvox.ros``. ``parameters`` and ``statistics`` do not import it either;
``sensors`` subscribes, ``as_message`` makes messages, ``node`` is what the nodes share.
"""
