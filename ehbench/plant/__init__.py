"""The plant: a rig put together from its parts, and its motion in time.

``layout`` says where everything lies, ``build`` packs a rig, ``derivatives`` are its laws,
``integrate`` brings it on in time, ``trim`` finds it at rest, ``model`` is what others use."""
