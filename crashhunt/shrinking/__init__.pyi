from ._search import Tried as Tried, fewest as fewest, plainest as plainest
from ._shrink import Shrunk as Shrunk, shrink as shrink, shrunk_name as shrunk_name
