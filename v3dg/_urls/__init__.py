"""Files at URLs, which fsspec knows: the parts in use, or all of a file, are fetched
into a nameless local file. `names` recognises and shows URLs, `addresses` says which
hosts may be contacted, `http` sends requests to web servers and bounds what their
answers cost, `others` does the same for other file systems, `failures` words the
errors, and `opened` has the local files.
"""

from v3dg._urls.names import beside as beside
from v3dg._urls.names import cleaned as cleaned
from v3dg._urls.names import folder_of as folder_of
from v3dg._urls.names import is_url as is_url
from v3dg._urls.names import shown as shown
from v3dg._urls.opened import FileAtUrl as FileAtUrl
from v3dg._urls.opened import in_parts as in_parts
from v3dg._urls.opened import reading as reading
